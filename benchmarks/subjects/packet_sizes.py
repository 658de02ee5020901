"""Round trips by the size of the packet and by discard limit, on each back end.

A round trip has one packet under way, so a discard limit of 4 changes nothing but the bookkeeping;
without one there are no acknowledgements.
"""

from __future__ import annotations

import functools

from benchmarks.measure import Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import (
    IMU_PACKET,
    PACKETS,
    Packet,
    bare,
    bare_one_process,
    dora_rs,
    neuros,
)

LIMITS = {
    "discard limit 0": {"discard_limit": 0},
    "discard limit 4": {"discard_limit": 4},
    "no discard limit": {},
}
BACKENDS = ("process", "in-process")
BARE = {"process": "rclpy.spin", "in-process": "rclpy, two nodes in one executor"}
DORA = "dora-rs"


def subject(is_quick: bool) -> Subject:
    """Round trips per run: few, as there are many runs."""
    count = 300 if is_quick else 1500
    groups = [_group(packet, backend, count) for packet in PACKETS for backend in BACKENDS]
    return Subject("round trip by size of the packet, discard limit and back end", tuple(groups))


def _group(packet: Packet, backend: str, count: int) -> Group:
    reference = BARE[backend]
    candidates: dict[str, Measurement] = {
        limit: functools.partial(neuros, packet, backend, count, connection=connection)
        for limit, connection in LIMITS.items()
    }
    cases = [_case(packet, backend, limit, reference) for limit in LIMITS]
    if backend == "in-process":
        candidates[reference] = functools.partial(bare_one_process, packet, count)
    else:
        candidates[reference] = functools.partial(bare, packet, count)
        if packet is not IMU_PACKET:  # it sends bytes, and no messages
            candidates[DORA] = functools.partial(dora_rs, packet, count)
            what = f"round trip, {packet.name}, {backend}, discard limit 0, against {DORA}"
            value = Figure("discard limit 0", "median")
            cases.append(Case(what, "us", value, Figure(DORA, "median"), against=DORA))
    return Group(candidates, tuple(cases), rounds=6)


def _case(packet: Packet, backend: str, limit: str, reference: str) -> Case:
    return Case(
        f"round trip, {packet.name}, {_words(backend)}, {limit}",
        "us",
        Figure(limit, "median"),
        Figure(reference, "median"),
        reference,
    )


def _words(backend: str) -> str:
    return "in process" if backend == "in-process" else backend
