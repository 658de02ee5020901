"""How long a packet needs there and back: hook to hook, acknowledged, nothing ever lost.

Between two processes against plain ``rclpy.spin``, which acknowledges nothing (same message, depth
and reliability, placed alike), and against dora-rs; in one process against two nodes in one
executor.
"""

from __future__ import annotations

import functools

from benchmarks.measure import Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import (
    CORE_EACH,
    IMU_PACKET,
    LARGE,
    ONE_CORE,
    SMALL,
    UNPINNED,
    Packet,
    bare,
    bare_one_process,
    dora_rs,
    neuros,
)
from neuros.transport.dds_profile import PROFILES


def subject(is_quick: bool) -> Subject:
    """Round trips per run: enough for a second."""
    count = 1000 if is_quick else 4000
    return Subject(
        "round trip of small and large packets, lossless",
        (
            _between_processes(count, CORE_EACH, "round-trip-core-each", None),
            _between_processes(count, ONE_CORE, "round-trip-one-core", None),
            _between_processes(count, UNPINNED, None, "round-trip-unpinned"),
            _in_process(SMALL, count, "round-trip-in-process"),
            _in_process(IMU_PACKET, count, None),
            _large(count),
        ),
    )


def _between_processes(
    count: int, place: str, bound: str | None, bound_against_dora: str | None
) -> Group:
    """Two processes; ``place`` says which cores they have."""
    what = f"round trip, {SMALL.name}, {place}"
    candidates: dict[str, Measurement] = {
        "NeuROS": functools.partial(neuros, SMALL, "process", count, place),
        "rclpy.spin": functools.partial(bare, SMALL, count, place),
        "dora-rs": functools.partial(dora_rs, SMALL, count, place),
    }
    cases = [
        _case(what, "rclpy.spin", bound),
        _case(f"{what}, against dora-rs", "dora-rs", bound_against_dora),
    ]
    if place == CORE_EACH:
        tuned = "rclpy.spin with NeuROS's settings of Fast DDS"
        candidates[tuned] = functools.partial(bare, SMALL, count, place, PROFILES)
        cases.append(_case(f"{what}, against tuned rclpy.spin", tuned, None))
    return Group(candidates, tuple(cases))


def _in_process(packet: Packet, count: int, bound: str | None) -> Group:
    reference = "rclpy, two nodes in one executor"
    return Group(
        {
            "NeuROS": functools.partial(neuros, packet, "in-process", count),
            reference: functools.partial(bare_one_process, packet, count),
        },
        (_case(f"round trip, {packet.name}, in process", reference, bound),),
    )


def _large(count: int) -> Group:
    what = f"round trip, {LARGE.name} there and 8 B back, unpinned"
    candidates: dict[str, Measurement] = {
        "NeuROS": functools.partial(neuros, LARGE, "process", count // 2),
        "dora-rs": functools.partial(dora_rs, LARGE, count // 2),
    }
    p99 = Case(f"{what}, p99", "us", Figure("NeuROS", "p99"), bound="large-packet-p99")
    return Group(candidates, (_case(what, "dora-rs", "large-packet"), p99))


def _case(name: str, reference: str, bound: str | None) -> Case:
    return Case(
        name,
        "us",
        Figure("NeuROS", "median"),
        Figure(reference, "median"),
        reference,
        bound,
    )
