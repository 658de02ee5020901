"""Many launches in a row: each has the same result, and nothing becomes more."""

from __future__ import annotations

import itertools
import json
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from endings import dead_shared_memory, stale_locks
from launching import LAUNCH, start

_PACKETS = 20
_MARK = "FAULT_MARK"
_SOURCE = f"""
from neuros.hooks import neuros_tick
sent = []
@neuros_tick(seconds=0.005, outputs="number")
def send(node):
    packet = node.make_packet("number")
    sent.append(packet)
    packet.data = len(sent)
    if len(sent) == {_PACKETS}:
        node.shutdown("all is sent")
    return packet
"""
_SINK = """
from neuros.hooks import neuros_function
@neuros_function(inputs="number")
def take(node, number):
    with open(node.run_dir / "taken", "a") as file:
        print(number.data, file=file)
"""
_TIMEOUT_S = 60.0
_OTHERS_CLEAN_UP_S = 3.0


@dataclass(frozen=True)
class Things:
    """What there is on the machine that runs could leave, by kind, as counts."""

    processes: int
    temporary_files: int
    lock_files: int
    control_sockets: int
    shared_memory_files: int

    def __str__(self) -> str:
        counted = (f"{kind.replace('_', ' ')}: {count}" for kind, count in vars(self).items())
        return ", ".join(counted)


class Launches:
    """Launches one project again and again.

    Args:
        folder: an empty one.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._mark = uuid.uuid4().hex
        self._since_s = time.time()
        self._temporary = folder / "tmp"
        self._temporary.mkdir()
        port = {"name": "number", "type": "std_msgs/msg/Int64"}
        nodes = []
        for name, text, ports in (("source", _SOURCE, "outputs"), ("sink", _SINK, "inputs")):
            (folder / f"{name}.py").write_text(text)
            node = {"name": name, "container": "neuros_python", "plugin": f"{name}.py"}
            nodes.append({**node, ports: [port]})
        ends = ("source_node", "source_output", "destination_node", "destination_input")
        connection = dict(zip(ends, ("source", "number", "sink", "number"), strict=True))
        project = {"nodes": nodes, "connections": [{**connection, "discard_limit": 0}]}
        (folder / "project.json").write_text(json.dumps(project))

    def one(self, backend: str) -> tuple[Any, ...]:
        """Launch it; returns its result, without what differs from time to time."""
        run = self._folder / uuid.uuid4().hex
        with start(
            self._folder / "project.json",
            *("--backend", backend, "-o", str(run)),
            cwd=self._folder,
            program=LAUNCH,
            **{"TMPDIR": str(self._temporary), _MARK: self._mark},
        ) as running:
            finished = running.finish(_TIMEOUT_S)
        counted = [
            (each["sent"], each["received"], each["consumed"])
            for each in finished.record.get("connections", [])
        ]
        taken = run / "sink" / "taken"
        return finished.exit_code, counted, taken.read_text() if taken.exists() else ""

    def things(self) -> Things:
        """What there is now."""
        marked = [
            process
            for process in psutil.process_iter(["environ"])
            if (process.info["environ"] or {}).get(_MARK) == self._mark
        ]
        return Things(
            len(marked),
            sum(1 for _ in self._temporary.rglob("*")),
            len(stale_locks()),
            sum(1 for _ in self._folder.rglob("control.sock")),
            len(dead_shared_memory(self._since_s)),
        )


EXPECTED = (0, [(_PACKETS,) * 3], "".join(f"{number}\n" for number in range(1, _PACKETS + 1)))
NOTHING = Things(0, 0, 0, 0, 0)


def launches(
    folder: Path, count: int, show: Callable[[int], object] = lambda number: None
) -> Iterator[str]:
    """Launch so many times, on back ends in turn; yields what was not as it must be.

    Args:
        folder: an empty one.
        show: is told the number of each launch that has ended.
    """
    bench = Launches(folder)
    backends = itertools.cycle(("process", "in-process"))
    for number, backend in zip(range(1, count + 1), backends, strict=False):
        try:
            result = bench.one(backend)
        except AssertionError as error:  # it has not ended in time, and was ended
            yield f"launch {number} ({backend}): {error}"
            continue
        if result != EXPECTED:
            yield f"launch {number} ({backend}): {result}"
        show(number)
    until_s = time.monotonic() + _OTHERS_CLEAN_UP_S
    while (things := bench.things()) != NOTHING and time.monotonic() < until_s:
        time.sleep(0.1)
    if things != NOTHING:
        yield f"left: {things}"
