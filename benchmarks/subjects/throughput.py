"""Packets and bytes per second from one node to another, by size, discard limit and back end."""

from __future__ import annotations

import functools

from benchmarks import flooding
from benchmarks.measure import Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import IMU_PACKET, PACKETS, SMALL, Packet
from benchmarks.subjects.packet_sizes import BACKENDS, DORA, LIMITS

BARE = "rclpy.spin"


def subject(is_quick: bool) -> Subject:
    """Seconds per run: few, as there are many runs."""
    seconds = 0.3 if is_quick else 1.0
    groups = tuple(_group(packet, seconds) for packet in PACKETS)
    return Subject("throughput by size of the packet, discard limit and back end", groups)


def _group(packet: Packet, seconds: float) -> Group:
    candidates: dict[str, Measurement] = {BARE: functools.partial(flooding.bare, packet, seconds)}
    if packet is not IMU_PACKET:  # it sends bytes, and no messages
        candidates[DORA] = functools.partial(flooding.dora_rs, packet, seconds)
    cases = []
    for backend in BACKENDS:
        for limit, connection in LIMITS.items():
            name = f"{backend.replace('in-', 'in ')}, {limit}"
            candidates[name] = functools.partial(
                flooding.neuros, packet, backend, seconds, connection
            )
            references = [BARE]
            if DORA in candidates and name == "process, discard limit 0":
                references.append(DORA)
            cases += [_case(packet, name, reference) for reference in references]
    return Group(candidates, tuple(cases), rounds=6)


def _case(packet: Packet, name: str, reference: str) -> Case:
    """Small packets are counted, large ones weighed."""
    is_small = packet in (SMALL, IMU_PACKET)
    figure, unit = ("rate", "1/s") if is_small else ("volume", "MB/s")
    what = f"throughput, {packet.name}, {name}"
    if reference != BARE:
        what += f", against {reference}"
    return Case(what, unit, Figure(name, figure), Figure(reference, figure), reference)
