"""Chains of 2 to 16 nodes: packets per second at their end, and how long one is under way.

The first node sends a packet every 10 ms for half a second, which gives the latency, and then as
fast as it may, which gives the rate. NeuROS loses nothing; bare rclpy loses what comes too fast.
"""

from __future__ import annotations

import functools

from benchmarks.graphs import bare_chain, chain
from benchmarks.measure import Case, Figure, Group, Subject

SIZES = (2, 4, 8, 16)
KINDS = {
    "process": ("process", "rclpy.spin"),
    "in-process": ("in process", "rclpy, one executor"),
}
ROUNDS = 5


def subject(is_quick: bool) -> Subject:
    """Seconds in which packets are counted."""
    seconds = 0.3 if is_quick else 1.0
    sizes = SIZES[:2] if is_quick else SIZES
    groups = [_chains(nodes, backend, seconds) for nodes in sizes for backend in KINDS]
    return Subject("chains of 2 to 16 nodes, lossless", tuple(groups))


def _chains(nodes: int, backend: str, seconds: float) -> Group:
    label, bare = KINDS[backend]
    candidates = {
        label: functools.partial(chain, nodes, backend, seconds),
        bare: functools.partial(bare_chain, nodes, backend == "in-process", seconds),
    }
    name = f"chain of {nodes}, {label}"
    cases = (
        Case(
            f"{name}, packets per second",
            "1/s",
            Figure(label, "rate"),
            Figure(bare, "rate"),
            bare,
        ),
        Case(f"{name}, share of the packets that {bare} delivers", "", Figure(bare, "delivered")),
        Case(
            f"{name}, latency",
            "us",
            Figure(label, "latency"),
            Figure(bare, "latency"),
            bare,
        ),
    )
    return Group(candidates, cases, ROUNDS)
