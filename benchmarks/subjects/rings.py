"""One packet goes round: packets per second, and what more nodes cost each of them.

A ring of 16 has 16 times as many nodes as cores could be said to need; what a packet costs should
not depend on them. Bare rclpy shows how much of that is the machine's.
"""

from __future__ import annotations

import functools

from benchmarks.graphs import bare_ring, ring
from benchmarks.measure import Case, Figure, Group, Quotient, Subject

FEW, MANY = 2, 16
LAPS = {("process", FEW): 4000, ("process", MANY): 250}
LAPS |= {("in-process", FEW): 20_000, ("in-process", MANY): 2500}
BARE_LAPS = {(False, FEW): 2500, (False, MANY): 200, (True, FEW): 2500, (True, MANY): 60}


def subject(is_quick: bool) -> Subject:
    """Laps per run: enough for a second or so."""
    share = 5 if is_quick else 1
    return Subject(
        "one packet in a ring of 2 and of 16 nodes, lossless",
        (_rings("process", share, "ring"), _rings("in-process", share, None)),
    )


def _rings(backend: str, share: int, bound: str | None) -> Group:
    is_one_process = backend == "in-process"
    label = "in process" if is_one_process else "process"
    bare = "rclpy, one executor" if is_one_process else "rclpy.spin"
    candidates = {}
    for nodes in (FEW, MANY):
        laps, bare_laps = LAPS[backend, nodes] // share, BARE_LAPS[is_one_process, nodes] // share
        candidates[f"{label}, {nodes}"] = functools.partial(ring, nodes, backend, laps)
        candidates[f"{bare}, {nodes}"] = functools.partial(
            bare_ring, nodes, is_one_process, bare_laps
        )

    def slow_down(of: str) -> Quotient:
        return Quotient(Figure(f"{of}, {FEW}"), Figure(f"{of}, {MANY}"))

    rates = tuple(
        Case(
            f"ring of {nodes}, {label}, packets per second",
            "1/s",
            Figure(f"{label}, {nodes}"),
            Figure(f"{bare}, {nodes}"),
            f"{bare}, unacknowledged",
        )
        for nodes in (FEW, MANY)
    )
    name = f"slow-down of a ring of {MANY} against one of {FEW}, {label}"
    factor = Case(name, "", slow_down(label), slow_down(bare), bare, bound)
    return Group(candidates, (*rates, factor))
