"""Files of another machine: those sent to it, and those that nodes write there.

*Trees* are sent: folders with files, identified by their content.

::

    ~/.cache/neuros/machines/         (or $XDG_CACHE_HOME/neuros/machines)
        <name>-<key>/                 a tree, always complete; the key is a digest of its content
        <name>-<key>.json             its files and their digests
        <name>-<key>.draft/           a tree in the making
        received/                     received content; a folder for each agent
        runs/                         run folders of agents

A new tree is copied from other trees as far as possible, and only the rest is sent. Changed files
of a tree are restored before it is used, and added ones are removed.

The files of nodes there appear in the run folder of the launcher: logs and recorded packets while
they are written, for the console and the recorder; everything else after the end of the nodes.
Nodes can put links into both run folders: none is followed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from pathlib import Path

from msgspec.structs import asdict

from neuros.caching import KEY_LENGTH, UNUSED_S, Kept, cache_root, kept_in
from neuros.errors import EnvironmentFault
from neuros_cluster.messages import Chunk, Tree, TreeFile

RECEIVED, RUNS = "received", "runs"
"""Folders of agents, beside the trees; the names of trees end with a key."""

MACHINES = "machines"
"""The folder in a run folder for files of no node: a folder for each machine."""

_CHUNK_BYTES = 1 << 16
_LOG = "node.log"
_SPOOL = "spool"
_LEFT_OUT = frozenset({"__pycache__", "runs", "node_modules"})
_RUN_FILE = "run.json"
_READ_BYTES = 1 << 20


def tree_cache(environ: Mapping[str, str]) -> Path:
    """The folder of all trees."""
    return cache_root(environ) / "machines"


def scan(name: str, folder: Path) -> Tree:
    """The tree of a folder: without hidden folders, caches of Python, and runs.

    Raises:
        EnvironmentFault: a file cannot be read.
    """
    try:
        files = [_file(path, folder) for path in _files(folder)] if folder.is_dir() else []
    except OSError as error:
        raise EnvironmentFault(
            f"{error.filename} cannot be read, and other machines need it: {error.strerror}"
        ) from error
    return Tree(name, tuple(sorted(files, key=lambda file: file.path)))


def key_of(tree: Tree) -> str:
    """The name of a tree in the cache."""
    text = json.dumps([asdict(file) for file in tree.files]).encode()
    return f"{tree.name}-{hashlib.sha256(text).hexdigest()[:KEY_LENGTH]}"


class TreeStore:
    """The trees of a machine.

    Args:
        cache: the folder that holds them.
    """

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        # Machines that share a home folder may have agents of one process id.
        self._received = cache / RECEIVED / os.urandom(6).hex()

    def lacking(self, trees: Sequence[Tree]) -> tuple[str, ...]:
        """The digests of content that this machine lacks."""
        known = self._known()
        wanted = {file.digest: file for tree in trees for file in tree.files}
        return tuple(digest for digest in wanted if not _find(known, digest))

    def receive(self, digest: str, data: bytes) -> None:
        """Append a part of a file. Raises ``OSError``."""
        self._received.mkdir(parents=True, exist_ok=True)
        with open(self._received / digest, "ab") as file:
            file.write(data)

    def place(self, tree: Tree) -> Path:
        """Make a tree whose content is here; returns its folder. Raises ``OSError``."""
        kept = Kept(self._cache / key_of(tree))
        known = self._known()
        with kept.locked():
            target = kept.folder if kept.folder.is_dir() else kept.beside(".draft")
            target.mkdir(parents=True, exist_ok=True)
            _remove_others(target, {file.path for file in tree.files})
            for file in tree.files:
                path = target / file.path
                if not _has(path, file.digest):
                    received = self._received / file.digest
                    source = received if _has(received, file.digest) else _find(known, file.digest)
                    _copy(source, path, file)
            if target != kept.folder:
                target.rename(kept.folder)
            kept.beside(".json").write_text(json.dumps([asdict(file) for file in tree.files]))
            os.utime(kept.folder)
        return kept.folder

    def clean_up(self) -> None:
        """Remove received content, and trees that were not used for a month."""
        shutil.rmtree(self._received, ignore_errors=True)
        oldest_s = time.time() - UNUSED_S
        for kept in map(Kept, kept_in(self._cache)):
            with contextlib.suppress(OSError), kept.locked(wait=False) as is_mine:
                if is_mine and kept.folder.stat().st_mtime < oldest_s:
                    shutil.rmtree(kept.folder, ignore_errors=True)
                    kept.beside(".json").unlink(missing_ok=True)

    def _known(self) -> dict[str, list[Path]]:
        """The files that should have a content, by digest."""
        found: dict[str, list[Path]] = {}
        for folder in kept_in(self._cache):
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                for each in json.loads(Kept(folder).beside(".json").read_text("utf-8")):
                    found.setdefault(each["digest"], []).append(folder / each["path"])
        return found


def digest_of(path: Path) -> str:
    """The SHA-256 of a file. Raises ``OSError``."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while data := file.read(_READ_BYTES):
            digest.update(data)
    return digest.hexdigest()


def _file(path: Path, folder: Path) -> TreeFile:
    status = path.stat()
    is_executable = bool(status.st_mode & 0o100)
    name = path.relative_to(folder).as_posix()
    return TreeFile(name, digest_of(path), status.st_size, is_executable)


def _files(folder: Path) -> Iterator[Path]:
    """The ordinary files below a folder; a link to a file counts as the file."""

    def fail(error: OSError) -> None:
        raise error

    for parent, folders, names in os.walk(folder, onerror=fail):
        here = Path(parent)
        folders[:] = [each for each in folders if not _is_left_out(here / each)]
        yield from (here / name for name in names if (here / name).is_file())


def _remove_others(folder: Path, wanted: Set[str]) -> None:
    """Remove files that a tree does not have, and emptied folders. Raises ``OSError``."""
    for path in [*_files(folder)]:
        if path.relative_to(folder).as_posix() not in wanted:
            path.unlink()
            for parent in path.parents:
                if parent == folder or any(parent.iterdir()):
                    break
                parent.rmdir()


def _is_left_out(folder: Path) -> bool:
    is_hidden = folder.name.startswith(".") or folder.name in _LEFT_OUT
    return is_hidden or (folder / _RUN_FILE).exists()


def _has(path: Path, digest: str) -> bool:
    try:
        return path.is_file() and digest_of(path) == digest
    except OSError:
        return False


def _find(known: Mapping[str, Sequence[Path]], digest: str) -> Path | None:
    return next((path for path in known.get(digest, ()) if _has(path, digest)), None)


def _copy(source: Path | None, path: Path, file: TreeFile) -> None:
    if source is None:
        raise OSError(f"{file.path} was changed while it was sent: launch again")
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.draft")
    shutil.copyfile(source, draft)
    draft.chmod(0o755 if file.is_executable else 0o644)
    draft.replace(path)


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
        with contextlib.suppress(OSError), open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            sent = self._sent.get(name, 0)
            if name not in self._sent or size < sent:
                self._sent[name] = sent = min(sent, size)
                yield Chunk(name, sent, b"")
            file.seek(sent)
            while data := file.read(_CHUNK_BYTES):
                offset = self._sent[name]
                self._sent[name] += len(data)  # before the yield: the caller may stop here
                yield Chunk(name, offset, data)


def write_chunk(run: Path, chunk: Chunk) -> int:
    """Write a part of a file into a run folder; returns its length. Raises ``OSError``."""
    path = Path(os.path.normpath(run / chunk.path))
    if path == run or not path.is_relative_to(run):
        raise OSError(f"{chunk.path} is outside of the run folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            file.truncate(chunk.offset)  # the file is open for appending
            file.write(chunk.data)
    except (ValueError, OverflowError) as error:  # neither a path nor an offset
        raise OSError(str(error)) from error
    return len(chunk.data)
