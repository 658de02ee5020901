"""Images of 0.9 MB in parallel: to 1 to 16 receivers, and from 1 to 8 cameras to one node.

Packets per second at all receivers together, lossless in NeuROS and dora-rs. Bare rclpy has Fast
DDS's shared memory, sends as fast as it can, and loses what comes too fast.
"""

from __future__ import annotations

import functools

from benchmarks import flooding
from benchmarks.measure import Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import LARGE
from benchmarks.subjects.packet_sizes import DORA
from benchmarks.subjects.throughput import BARE

RECEIVERS = (1, 4, 16)
CAMERAS = (4, 8)
ROUNDS = 5


def subject(is_quick: bool) -> Subject:
    """Seconds in which packets are counted."""
    seconds = 0.3 if is_quick else 1.0
    groups = [_group(f"to {n} receivers", seconds, receivers=n) for n in RECEIVERS]
    groups += [_group(f"from {n} cameras", seconds, senders=n) for n in CAMERAS]
    return Subject("images of 921,600 B in parallel", tuple(groups))


def _group(what: str, seconds: float, *, senders: int = 1, receivers: int = 1) -> Group:
    ends = {"senders": senders, "receivers": receivers}
    lossless = {"discard_limit": 0}
    candidates: dict[str, Measurement] = {
        "process": functools.partial(flooding.neuros, LARGE, "process", seconds, lossless, **ends),
        BARE: functools.partial(flooding.bare, LARGE, seconds, **ends),
        DORA: functools.partial(flooding.dora_rs, LARGE, seconds, **ends),
    }
    cases = tuple(
        Case(
            f"images {what}, against {name}",
            "1/s",
            Figure("process", "rate"),
            Figure(name, "rate"),
            name,
        )
        for name in (BARE, DORA)
    )
    return Group(candidates, cases, ROUNDS)
