"""Files of another machine: those sent to it, and those that nodes write there.

*Trees* are sent: folders with files, identified by their content.

::

    ~/.cache/neuros/machines/         (or $XDG_CACHE_HOME/neuros/machines)
        <name>-<key>/                 a tree, always complete; the key is a digest of its content
        <name>-<key>.draft/           a tree in the making
        received/                     received content; a folder for each agent
        runs/                         run folders of agents

A new tree is copied from the last one of its name as far as possible, and only the rest is sent.
Changed files of a tree are restored before it is used, and added ones are removed.

The files of nodes there appear in the run folder of the launcher: logs and recorded packets while
they are written, for the console and the recorder; everything else after the end of the nodes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from neuros.caching import KEY_LENGTH, UNUSED_S, Kept, cache_root, kept_in
from neuros.errors import EnvironmentFault
from neuros.ordinary_files import digest_of
from neuros_cluster.messages import Chunk, Tree

RECEIVED, RUNS = "received", "runs"
"""Folders of agents, beside the trees; the names of trees end with a key."""

MACHINES = "machines"
"""The folder in a run folder for files of no node: a folder for each machine."""

_CHUNK_BYTES = 1 << 16
_LOG = "node.log"
_SPOOL = "spool"
_LEFT_OUT = frozenset({"__pycache__", "runs", "node_modules"})
_RUN_FILE = "run.json"
_EXECUTABLE = "+x"


def tree_cache(environ: Mapping[str, str]) -> Path:
    return cache_root(environ) / "machines"


def scan(name: str, folder: Path) -> Tree:
    """The tree of a folder: without hidden folders, caches of Python, and runs.

    Raises:
        EnvironmentFault: a file cannot be read.
    """
    try:
        paths = sorted(_files(folder)) if folder.is_dir() else []
        files = {
            path.relative_to(folder).as_posix(): digest_of(path)
            + (_EXECUTABLE if os.access(path, os.X_OK) else "")
            for path in paths
        }
    except OSError as error:
        raise EnvironmentFault(
            f"{error.filename} cannot be read, and other machines need it: {error.strerror}"
        ) from error
    return Tree(name, files)


class TreeStore:
    """The trees of a machine.

    Args:
        cache: the folder that holds them.

    Attributes:
        received: the folder for received files, with a folder for each tree by its name.
    """

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        # Machines that share a home folder may have agents of one process id.
        self.received = cache / RECEIVED / os.urandom(6).hex()

    def lacking(self, tree: Tree) -> tuple[str, ...]:
        """The paths of a tree's files that this machine lacks."""
        places = self._places(tree)
        return tuple(path for path in tree.files if _find(tree, path, places) is None)

    def place(self, tree: Tree) -> Path:
        """Make a tree whose files are here; returns its folder. Raises ``OSError``."""
        kept, places = self._kept(tree), self._places(tree)
        with kept.locked():
            target = kept.folder if kept.folder.is_dir() else kept.beside(".draft")
            target.mkdir(parents=True, exist_ok=True)
            for path in [*_files(target)]:
                if path.relative_to(target).as_posix() not in tree.files:
                    path.unlink()
                    with contextlib.suppress(OSError):  # it has other files
                        os.removedirs(path.parent)
            target.mkdir(parents=True, exist_ok=True)
            for name, content in tree.files.items():
                path, source = target / name, _find(tree, name, [target, *places])
                if source is None:
                    raise OSError(f"{name} was changed while it was sent: launch again")
                if source != path:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    draft = path.with_name(f"{path.name}.draft")
                    shutil.copyfile(source, draft)
                    draft.chmod(0o755 if content.endswith(_EXECUTABLE) else 0o644)
                    draft.replace(path)
            if target != kept.folder:
                target.rename(kept.folder)
            os.utime(kept.folder)
        return kept.folder

    def clean_up(self) -> None:
        """Remove received content, and trees that were not used for a month."""
        shutil.rmtree(self.received, ignore_errors=True)
        oldest_s = time.time() - UNUSED_S
        for kept in map(Kept, kept_in(self._cache)):
            with contextlib.suppress(OSError), kept.locked(wait=False) as is_mine:
                if is_mine and kept.folder.stat().st_mtime < oldest_s:
                    shutil.rmtree(kept.folder, ignore_errors=True)

    def _kept(self, tree: Tree) -> Kept:
        key = hashlib.sha256(json.dumps(tree.files).encode()).hexdigest()[:KEY_LENGTH]
        return Kept(self._cache / f"{tree.name}-{key}")

    def _places(self, tree: Tree) -> list[Path]:
        """Where its files may be: in place, in the last tree of its name, or received."""
        trees = [each for each in kept_in(self._cache) if each.is_dir()]
        others = [each for each in trees if each.name.rpartition("-")[0] == tree.name]
        last = sorted(others, key=lambda each: each.stat().st_mtime)[-1:]
        return [self._kept(tree).folder, *last, self.received / tree.name]


def _find(tree: Tree, path: str, places: Sequence[Path]) -> Path | None:
    digest = tree.files[path].removesuffix(_EXECUTABLE)
    for file in (place / path for place in places):
        with contextlib.suppress(OSError):
            if file.is_file() and digest_of(file) == digest:
                return file
    return None


def _files(folder: Path) -> Iterator[Path]:
    """The ordinary files below a folder; a link to a file counts as the file."""

    def fail(error: OSError) -> None:
        raise error

    for parent, folders, names in os.walk(folder, onerror=fail):
        here = Path(parent)
        folders[:] = [
            name
            for name in folders
            if not (name.startswith(".") or name in _LEFT_OUT or (here / name / _RUN_FILE).exists())
        ]
        yield from (here / name for name in names if (here / name).is_file())


class Follower:
    """Reads the files of a run folder as they grow.

    Args:
        run: the run folder.
        nodes: the nodes with a folder in there.
        machine: the name of this machine.
        known: files from the launcher, relative to the run folder.
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
        """New parts of the log and the recorded packets of a node."""
        folder = self._run / node
        yield from self._news(folder / _LOG)
        # In order: a file with a successor does not grow any more, and is read to its end first.
        with contextlib.suppress(OSError):
            for name in sorted(os.listdir(folder / _SPOOL)):
                yield from self._news(folder / _SPOOL / name)

    def rest(self) -> Iterator[Chunk]:
        """New parts of all other files of the run folder."""
        for parent, _, names in os.walk(self._run):
            for name in names:
                path = Path(parent, name)
                if path.relative_to(self._run).as_posix() not in self._known:
                    yield from self._news(path)

    def _news(self, path: Path) -> Iterator[Chunk]:
        """The unsent parts of a file, which may have become shorter."""
        relative = path.relative_to(self._run)
        name = relative.as_posix()
        if relative.parts[0] not in self._nodes:
            name = f"{MACHINES}/{self._machine}/{name}"
        if not path.is_file():  # a plugin may make a pipe
            return
        with contextlib.suppress(OSError):
            for chunk in chunks_of(path, name, self._sent.get(name, 0)):
                self._sent[name] = chunk.offset + len(chunk.data)  # the caller may stop here
                yield chunk


def chunks_of(path: Path, name: str, sent: int = 0) -> Iterator[Chunk]:
    """The parts of a file from an offset, or from its end if it is shorter.

    The first part that is sent of a file, and of one that has become shorter, may be empty. Raises
    ``OSError``.
    """
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if not sent or size < sent:
            sent = min(sent, size)
            yield Chunk(name, sent, b"")
        file.seek(sent)
        while data := file.read(_CHUNK_BYTES):
            yield Chunk(name, file.tell() - len(data), data)


def write_chunk(folder: Path, chunk: Chunk) -> int:
    """Write a part of a file into a folder; returns its length. Raises ``OSError``."""
    path = Path(os.path.normpath(folder / chunk.path))
    if path == folder or not path.is_relative_to(folder):
        raise OSError(f"{chunk.path} is outside of the folder {folder.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            file.truncate(chunk.offset)  # the file is open for appending
            file.write(chunk.data)
    except (ValueError, OverflowError) as error:  # neither a path nor an offset
        raise OSError(str(error)) from error
    return len(chunk.data)
