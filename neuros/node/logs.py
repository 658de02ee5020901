"""Logs of a node in the folder of its run: of its packets, and of the world that it simulates.

The packet log says when each packet was sent and taken, and has its digest.

``<node>/packets/<index of the connection>.<what>`` are lists of 8-byte numbers, in the byte order
of the machine, one per packet:

========= ==========================================================================
sent_ns   at the sender: monotonic time at which the hook that returned it had ended
digests   at the sender: of each packet sent; at the receiver: of each received
taken     at the receiver: the position (from 1) of a packet that a hook has started on
taken_ns  when that was
========= ==========================================================================

A list that has filled a quarter of its room goes on in another file, whose name ends with the
number of entries before it, as ``3.sent_ns.524288``. With four files full, the oldest one goes. In
a recorded run a list ends instead, since a replay begins at the start.

``<node>/packets/pauses`` has when the node stood still, since the run was paused: start and end of
each such time.

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
from neuros.ports import Logger, WorldLook
from neuros.project.model import Connection

FOLDER = "packets"
EVENT_LOG = "event_log"

MOST_BYTES = 64_000_000
"""Of the event log, which is 8 million entries; what comes later is left out."""
_FILES = 4


class _List:
    """A list of 8-byte numbers in files, which have ``most_bytes`` together.

    ``keeps_first``: with no room left, the newest entries are left out, and not the oldest.
    """

    def __init__(self, file: Path, most_bytes: int, *, keeps_first: bool) -> None:
        self._file = file
        self._keeps_first = keeps_first
        self._file_bytes = max(8, most_bytes // (1 if keeps_first else _FILES) // 8 * 8)
        self._files = [file]
        self._room = self._file_bytes  # in the newest file
        self._written = 0

    def append(self, data: bytes) -> None:
        """Write entries. Raises ``OSError``."""
        while data:
            if not self._room:
                if self._keeps_first:
                    return
                if len(self._files) == _FILES:
                    self._files.pop(0).unlink(missing_ok=True)
                self._files.append(self._file.with_name(f"{self._file.name}.{self._written // 8}"))
                self._room = self._file_bytes
            part, data = data[: self._room], data[self._room :]
            with open(self._files[-1], "ab") as file:
                file.write(part)
            self._room -= len(part)
            self._written += len(part)


class PacketLog:
    """Writes the packet log of one node.

    Args:
        folder: the node's own.
        digests: by connection, those since they were last written; empty if there are none.
        list_bytes: so much each list of packets has at most; 0: only the event log is written.

    Attributes:
        failure: why nothing more is written, ``None`` while all is well.
    """

    def __init__(
        self,
        engine: Engine,
        digests: Mapping[Connection, array[int]],
        folder: Path,
        list_bytes: int = MOST_BYTES,
    ) -> None:
        self._engine = engine
        self._digests = digests
        self._folder = folder / FOLDER
        self._list_bytes = list_bytes
        self._lists: dict[str, _List] = {}
        self._hooks_written = 0
        self._lock = threading.Lock()
        self.failure: str | None = None

    def begin_anew(self, engine: Engine) -> None:
        """Give up what has been written: the node was reset, and has this engine now."""
        with self._lock:
            self._engine = engine
            self._lists.clear()
            self._hooks_written = 0
            for digests in self._digests.values():
                del digests[:]
            shutil.rmtree(self._folder, ignore_errors=True)

    def write(self) -> None:
        """Write what has come since the last time. Any thread, but the node's own hooks go on."""
        with self._lock:
            try:
                self._write()
            except OSError as error:  # what is left waits in memory until the next time
                self.failure = (
                    f"{self._folder} could not be written to ({error.strerror}): latencies and"
                    " digests end there"
                )

    def _write(self) -> None:
        for name, entries in self._all():
            # Each is one step for the interpreter: what is appended meanwhile stays for later.
            count = len(entries)
            data = entries[:count].tobytes()
            del entries[:count]
            is_kept = self._list_bytes or name == EVENT_LOG
            if not (data and name and is_kept) or self.failure is not None:
                continue
            if name not in self._lists:
                is_of_packets = "." in name
                self._lists[name] = _List(
                    self._folder / name,
                    self._list_bytes if is_of_packets else MOST_BYTES,
                    keeps_first=not is_of_packets or self._engine.event_log is not None,
                )
            self._folder.mkdir(parents=True, exist_ok=True)
            self._lists[name].append(data)
        hooks = self._engine.execution_log.hooks[:] if self._list_bytes else []
        if len(hooks) > self._hooks_written and self.failure is None:
            self._hooks_written = len(hooks)
            text = json.dumps([{"name": name, "kind": kind} for name, kind in hooks])
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / "hooks.json").write_text(text, "utf-8")

    def _all(self) -> Iterator[tuple[str, array[Any]]]:
        for connection, window in self._engine.send_windows.items():
            yield f"{connection.index}.sent_ns", window.sent_ns
        for key, subscription in self._engine.subscriptions.items():
            # The sending time of a packet of an external topic is unknown: only room is made.
            name = f"{key.index}." if isinstance(key, Connection) else ""
            yield name and f"{name}taken", subscription.taken
            yield name and f"{name}taken_ns", subscription.taken_ns
        yield "pauses", self._engine.pauses.still_ns
        yield "executions", self._engine.execution_log.executions
        yield "credits", self._engine.execution_log.credits
        if self._engine.event_log is not None:
            yield EVENT_LOG, self._engine.event_log
        for connection, digests in self._digests.items():
            yield f"{connection.index}.digests", digests


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
