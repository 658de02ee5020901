"""One sender with N receivers, and N senders with one receiver: packets per second.

Counted where they arrive, at all receivers together. NeuROS loses nothing and gives every receiver
every packet; bare rclpy sends as often as its executor comes round, and loses what comes too fast.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

from benchmarks.graphs import bare_many_to_one, bare_one_to_many, many_to_one, one_to_many
from benchmarks.measure import Case, Figure, Group, Subject

SIZES = (2, 4, 8)
ROUNDS = 5
KINDS = {
    "process": ("process", "rclpy.spin"),
    "in-process": ("in process", "rclpy, one executor"),
}


def subject(is_quick: bool) -> Subject:
    """Seconds in which packets are counted."""
    seconds = 0.3 if is_quick else 0.8
    sizes = SIZES[:1] if is_quick else SIZES
    groups = []
    for count in sizes:
        for backend in KINDS:
            groups.append(_fan("1-to", count, backend, seconds, one_to_many, bare_one_to_many))
            groups.append(_fan("to-1", count, backend, seconds, many_to_one, bare_many_to_one))
    return Subject("one to many and many to one, lossless", tuple(groups))


def _fan(
    kind: str,
    count: int,
    backend: str,
    seconds: float,
    neuros: Callable[[int, str, float], float],
    bare: Callable[[int, bool, float], float],
) -> Group:
    label, reference = KINDS[backend]
    name = f"1-to-{count}" if kind == "1-to" else f"{count}-to-1"
    case = Case(
        f"{name}, {label}, packets per second",
        "1/s",
        Figure(label),
        Figure(reference),
        reference,
    )
    candidates = {
        label: functools.partial(neuros, count, backend, seconds),
        reference: functools.partial(bare, count, backend == "in-process", seconds),
    }
    return Group(candidates, (case,), ROUNDS)
