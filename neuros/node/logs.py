"""Logs of a node in the folder of its run: of its packets, and of the world that it simulates.

The packet log says when each packet was sent and taken, and has its digest.

``<node>/packets/<index of the connection>.<what>`` are files of 8-byte numbers, in the byte order
of the machine, one per packet:

========= ==========================================================================
sent_ns   at the sender: monotonic time at which the hook that returned it had ended
digests   at the sender: of each packet sent; at the receiver: of each received
taken     at the receiver: the position (from 1) of a packet that a hook has started on
taken_ns  when that was
========= ==========================================================================

``<node>/packets/executions`` has the first executions of the node's hooks (the place of the hook in
``hooks.json``, start and end), ``credits`` the acknowledgements that arrived meanwhile (index of
the connection, position, time): three 8-byte numbers each.

Where packets are recorded, ``event_log`` has what happened to the engine (see
:mod:`neuros.engine.event_log`), so that the node can be replayed.

An entry costs the node's thread some 50 ns. The thread that reports to the supervisor writes them
out once per second.

The world log says how a simulated world has moved in a recorded run, for ``neuros report`` to show.

``<node>/world.jsonl`` has a JSON object per line: ``version`` of the geometry; ``geometry``, as
JSON text, where that is another one than in the line before; ``frames``: lists of wall and
simulated time in seconds, and poses (see :mod:`neuros.simulators.mujoco.scene`).
"""

from __future__ import annotations

import json
import shutil
import threading
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neuros.engine.engine import Engine
from neuros.engine.event_log import LoggedEngine
from neuros.ports import Logger, WorldLook
from neuros.project.model import Connection

FOLDER = "packets"
EVENT_LOG = "event_log"

MOST_ENTRIES = 8_000_000
"""Of a file, 64 MB; what comes later is counted and not listed."""


class PacketLog:
    """Writes the packet log of one node.

    Args:
        folder: the node's own.
        digests: by connection, those since they were last written; empty if there are none.

    Attributes:
        failure: why nothing more is written, ``None`` while all is well.
    """

    def __init__(
        self, engine: Engine, digests: Mapping[Connection, array[int]], folder: Path
    ) -> None:
        self._engine = engine
        self._digests = digests
        self._folder = folder / FOLDER
        self._written: dict[str, int] = {}
        self._hooks_written = 0
        self._lock = threading.Lock()
        self.failure: str | None = None

    def begin_anew(self, engine: Engine) -> None:
        """Give up what has been written: the node was reset, and has this engine now."""
        with self._lock:
            self._engine = engine
            self._written.clear()
            self._hooks_written = 0
            for digests in self._digests.values():
                del digests[:]
            shutil.rmtree(self._folder, ignore_errors=True)

    def write(self) -> None:
        """Write what has come since the last time. Any thread, but the node's own hooks go on."""
        with self._lock:
            for name, entries in self._all():
                # Each is one step for the interpreter: what is appended meanwhile stays for later.
                count = len(entries)
                data = entries[:count].tobytes()
                del entries[:count]
                if data and name and self.failure is None:
                    self._append(name, data)
            hooks = self._engine.execution_log.hooks[:]
            if len(hooks) > self._hooks_written and self.failure is None:
                self._hooks_written = len(hooks)
                self._write_hooks(hooks)

    def _all(self) -> Iterator[tuple[str, array[Any]]]:
        for connection, window in self._engine.send_windows.items():
            yield f"{connection.index}.sent_ns", window.sent_ns
        for key, subscription in self._engine.subscriptions.items():
            # The sending time of a packet of an external topic is unknown: only room is made.
            name = f"{key.index}." if isinstance(key, Connection) else ""
            yield name and f"{name}taken", subscription.taken
            yield name and f"{name}taken_ns", subscription.taken_ns
        yield "executions", self._engine.execution_log.executions
        yield "credits", self._engine.execution_log.credits
        if isinstance(self._engine, LoggedEngine):
            yield EVENT_LOG, self._engine.event_log
        for connection, digests in self._digests.items():
            yield f"{connection.index}.digests", digests

    def _append(self, name: str, data: bytes) -> None:
        room = MOST_ENTRIES * 8 - self._written.get(name, 0)
        data = data[: max(0, room)]
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with open(self._folder / name, "ab") as file:
                file.write(data)
        except OSError as error:
            self._fail(error)
        self._written[name] = self._written.get(name, 0) + len(data)

    def _write_hooks(self, hooks: list[tuple[str, str]]) -> None:
        text = json.dumps([{"name": name, "kind": kind} for name, kind in hooks])
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / "hooks.json").write_text(text, "utf-8")
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = (
            f"{self._folder} could not be written to ({error.strerror}): latencies and digests"
            " end there"
        )


WORLD_LOG = "world.jsonl"
_ASKER = -1  # observers have numbers from 1


class WorldLog:
    """Writes the world of one node, about once per second. ``folder`` is the node's own.

    Attributes:
        failure: why nothing more is written, ``None`` while all is well.
    """

    def __init__(self, folder: Path, logger: Logger) -> None:
        self._file = folder / WORLD_LOG
        self._logger = logger
        self._version: str | None = None
        self.failure: str | None = None
        self._lock = threading.Lock()

    def write(self, look: WorldLook) -> None:
        """Add the frames since the last time. Any thread; what fails ends the log, not the run."""
        with self._lock:
            if self.failure is not None:
                return
            try:
                seen = dict(look({"frames": True}, _ASKER))
                if seen["version"] != self._version:
                    seen |= look({"geometry": True}, _ASKER)
                    self._version = seen["version"]
                with self._file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(seen) + "\n")
            except Exception as error:
                self.failure = f"its world is not recorded to the end: {error}"
                self._logger.warning(f"the world is not recorded any more: {error}")
