"""Mirror: what nodes write on another machine appears in the run folder of the launcher.

Logs, stack files and recorded packets while they are written, so that the console, the stall
detector and the recorder find them as ever; everything else once the nodes have ended.
"""

from __future__ import annotations

import contextlib
import os
from base64 import b64decode, b64encode
from collections.abc import Collection, Iterator
from pathlib import Path

from neuros.control.machines import Chunk
from neuros.stacks import FILE_NAME as STACK

MACHINES = "machines"
"""The folder in a run folder with what belongs to no node: a folder for each machine."""

_CHUNK_BYTES = 1 << 16
_FOLLOWED = ("node.log", STACK)
_SPOOL = "spool"


class Follower:
    """Files of a run folder as they grow.

    Args:
        run: the run folder.
        nodes: those that have a folder in there.
        machine: what this machine is called.
        known: files that the launcher has given, relative to the run folder.
    """

    def __init__(
        self, run: Path, nodes: Collection[str], machine: str, known: Collection[str]
    ) -> None:
        self._run = run
        self._nodes = nodes
        self._machine = machine
        self._known = frozenset(known)
        self._sent: dict[str, int] = {}

    def grown(self, node: str) -> Iterator[Chunk]:
        """What has come to the logs and to the recorded packets of a node."""
        folder = self._run / node
        for name in _FOLLOWED:
            yield from self._news(folder / name)
        # One that has a successor does not grow any more, and is read to its end before that.
        with contextlib.suppress(OSError):
            for name in sorted(os.listdir(folder / _SPOOL)):
                yield from self._news(folder / _SPOOL / name)

    def rest(self) -> Iterator[Chunk]:
        """Everything else that has been written in the run folder."""
        for parent, _, names in os.walk(self._run):
            for name in names:
                path = Path(parent, name)
                is_new = path.relative_to(self._run).as_posix() not in self._known
                is_new = is_new and name != STACK
                if is_new and path.is_file() and not path.is_symlink():
                    yield from self._news(path)

    def _news(self, path: Path) -> Iterator[Chunk]:
        """What a file has beyond what was sent of it; it may have become shorter."""
        relative = path.relative_to(self._run)
        name = relative.as_posix()
        if relative.parts[0] not in self._nodes:
            name = f"{MACHINES}/{self._machine}/{name}"
        with contextlib.suppress(OSError), open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            sent = self._sent.get(name, 0)
            if name not in self._sent or size < sent:
                self._sent[name] = sent = min(sent, size)
                yield Chunk(name, sent, "")
            file.seek(sent)
            while data := file.read(_CHUNK_BYTES):
                offset = self._sent[name]
                self._sent[name] += len(data)  # who takes it may not ask for more
                yield Chunk(name, offset, b64encode(data).decode())


def write_chunk(run: Path, chunk: Chunk) -> int:
    """Write a part of a file into a run folder; returns its length. Raises ``OSError``."""
    path = Path(os.path.normpath(run / chunk.path))
    if not path.is_relative_to(run):
        raise OSError(f"{chunk.path} is outside of the run folder")
    data = b64decode(chunk.data)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    with open(descriptor, "wb") as file:
        if chunk.offset < os.fstat(descriptor).st_size:
            file.truncate(chunk.offset)
        file.seek(chunk.offset)
        file.write(data)
    return len(data)
