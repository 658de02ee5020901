"""Runs examples under changing load, and tells the packets of a run by one digest.

In real time those are strict examples. In virtual time they lose packets, tick, or have physics
that runs by itself; then the digest is also that of what hooks consumed, and when.
"""

from __future__ import annotations

import contextlib
import json
import platform
import random
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from xxhash import xxh3_64_hexdigest

from tests.load.running import busy_processes
from tests.support.launching import EXAMPLES, Finished, launch

BACKENDS = ("in-process", "process", "docker")
STRICT: dict[str, tuple[str, ...]] = {
    "2_synchronisation/tennis": (),
    "2_synchronisation/voting": (),
    "4_neurorobotics/whiskeye/strict.json": ("--duration", "4sim"),
    "4_neurorobotics/whiskeye/custom_messages.json": ("--duration", "4sim"),
    "4_neurorobotics/whiskeye/room.json": ("--duration", "4sim"),
}
"""The examples that keep the conditions of docs/deterministic_runs.md, with how they end."""

_VIRTUAL = ("--time", "virtual", "--set")
_WHISKEYE = (
    *(*_VIRTUAL, "nodes.robot.environment.DURATION=2", "--set"),
    'nodes.snn.durations.integrate={"normal":[0.045,0.005]}',
)
_ELEVATOR = (*_VIRTUAL, 'nodes.controller.durations.control={"uniform":[0.01,0.12]}')
VIRTUAL: dict[str, tuple[str, ...]] = {
    "4_neurorobotics/whiskeye/no_discard_limit.json": _WHISKEYE,
    "4_neurorobotics/whiskeye/asynchronous.json": _WHISKEYE,
    "4_neurorobotics/whiskeye/project.json": _WHISKEYE,
    "4_neurorobotics/whiskeye/tick_60ms.json": _WHISKEYE,
    "3_physics_simulation/elevator/no_discard_limit.json": _ELEVATOR,
    "3_physics_simulation/elevator/asynchronous.json": _ELEVATOR,
    "1_tick/clock": (*_VIRTUAL, "nodes.display.durations.show=0.03", "--duration", "10"),
}
"""Examples for virtual time: in real time, all but the last depend on the load of the machine."""

_PATIENCE_S = 300.0
_TIMED = ("digests", "latency_ms", "sent", "received", "consumed", "discarded", "lost")
_MOST_BUSY = 3
_CHANGES_S = (0.2, 2.0)


@dataclass
class Repeated:
    """Runs of one example on one back end.

    Attributes:
        digests: how many runs had each.
        packets: in a run.
        problems: why runs have no digest.
    """

    project: str
    backend: str
    python: str = platform.python_version()
    packets: int = 0
    digests: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)


def repeat(project: str, backend: str, runs: int, folder: Path) -> Repeated:
    """Run an example ``runs`` times in folders below ``folder``."""
    repeated = Repeated(project, backend)
    options = (*(STRICT | VIRTUAL)[project], "--backend", backend, "--digests")
    for number in range(runs):
        cwd = folder / str(number)
        cwd.mkdir()
        finished = launch(EXAMPLES / project, *options, cwd=cwd, timeout_s=_PATIENCE_S)
        if finished.exit_code:
            reason = finished.record.get("reason", finished.output[-500:])
            repeated.problems.append(f"run {number}: exit code {finished.exit_code}: {reason}")
        else:
            digest, repeated.packets = _digest_of(finished)
            repeated.digests[digest] += 1
    return repeated


def _digest_of(finished: Finished) -> tuple[str, int]:
    """One digest of all packets that no connection may lose, and how many there are.

    In virtual time: of all packets, those that were consumed, and when.
    """
    record = finished.record
    if "virtual_s" in record:
        told = {each["connection"]: [each[key] for key in _TIMED] for each in record["connections"]}
        hooks = {name: node["hooks"] for name, node in record["nodes"].items()}
        known = json.dumps([told, hooks, record["virtual_s"]], sort_keys=True)
        return xxh3_64_hexdigest(known.encode()), sum(e["sent"] for e in record["connections"])
    lossless = [each for each in finished.record["connections"] if each["discard_limit"] == 0]
    told = {each["connection"]: each["digests"] for each in lossless}
    packets = sum(each["sent_packets"] for each in told.values() if each)
    return xxh3_64_hexdigest(json.dumps(told, sort_keys=True).encode()), packets


@contextlib.contextmanager
def changing_load(seed: int) -> Iterator[None]:
    """Busy processes that come and go, at most three at a time, while the block lasts."""
    is_over, drawn = threading.Event(), random.Random(seed)

    def come_and_go() -> None:
        while not is_over.is_set():
            with busy_processes(drawn.randint(0, _MOST_BUSY)):
                is_over.wait(drawn.uniform(*_CHANGES_S))

    thread = threading.Thread(target=come_and_go)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def differing(found: Sequence[Repeated]) -> list[str]:
    """The projects that had more than one digest, on one back end or on all."""
    by_project: dict[str, set[str]] = {}
    for each in found:
        by_project.setdefault(each.project, set()).update(each.digests)
    return [project for project, digests in by_project.items() if len(digests) > 1]
