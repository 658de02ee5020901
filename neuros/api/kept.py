"""Values that plugins have kept in a run: found again, restored to another run, and read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from neuros.errors import UsageError
from neuros.node.keeping import KEPT, RESTORED, SUFFIX, decoded
from neuros.ordinary_files import open_ordinary
from neuros.project.model import NodeFile
from neuros.project.suggest import did_you_mean, listed

Sources = Mapping[str, Mapping[str, Path]]
"""Files with values to restore, by node and name."""


def given_sources(given: Mapping[str, Any] | Iterable[str] | None) -> dict[str, Any]:
    """What is given as ``restore``, by ``node.name``; on the command line it is text.

    Raises:
        UsageError: for text that is no ``node.name=run``.
    """
    if isinstance(given, Mapping):
        return dict(given)
    found: dict[str, Any] = {}
    for text in given or ():
        name, _, source = text.partition("=")
        if not (name and source):
            raise UsageError(f"--restore {text}: give it as in --restore brain.weights=RUN")
        found[name] = source
    return found


def find_sources(given: Mapping[str, Any], nodes: Iterable[str]) -> Sources:
    """The file of each value that is to be restored.

    Args:
        given: by ``node.name``, a run, its folder, or a file.
        nodes: those that are started.

    Raises:
        UsageError: if there is no such node or value, or a file holds none.
    """
    names, found = [*nodes], dict[str, dict[str, Path]]()
    for value, source in given.items():
        node, _, name = value.partition(".")
        if node not in names or not name:
            hint = did_you_mean(node, names) if node not in names else "say node.name"
            hint = hint or f"nodes are {', '.join(names)}"
            raise UsageError(f"restore: '{value}' is nothing that a node keeps ({hint})")
        file = _file_in(Path(getattr(source, "folder", source)).absolute(), node, name)
        read_value(file)
        found.setdefault(node, {})[name] = file
    return found


def copy_sources(sources: Sources, run_folder: Path) -> None:
    """Put copies into the folders of the nodes of a new run. Raises ``OSError``."""
    for node, files in sources.items():
        folder = run_folder / node / RESTORED
        folder.mkdir(parents=True)
        for name, file in files.items():
            (folder / f"{name}{SUFFIX}").write_bytes(file.read_bytes())


def record_of_values(run_folder: Path, file: NodeFile) -> dict[str, dict[str, Any]]:
    """What ``run.json`` says of the values that a node has kept, and of those restored to it."""
    node = run_folder / file.node.name
    kept = {path.stem: _described(path) for path in sorted((node / KEPT).glob(f"*{SUFFIX}"))}
    restored = {
        name: {"from": source, **_described(node / RESTORED / f"{name}{SUFFIX}")}
        for name, source in file.restored.items()
    }
    both = {"kept": kept, "restored": restored}
    return {key: values for key, values in both.items() if values}


def kept_value(run_folder: Path, value: str) -> Any:
    """What a node has kept in a run, by ``node.name``. Raises ``UsageError``: nothing of it."""
    node, _, name = value.partition(".")
    return read_value(_file_in(run_folder, node, name))


def read_value(file: Path) -> Any:
    """The value in a file.

    Raises:
        UsageError: if it holds none.
    """
    try:
        with open_ordinary(file) as content:
            return decoded(content.read())
    except OSError as error:
        raise UsageError(f"{file} cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise UsageError(f"{file}: {error}") from None


def _file_in(source: Path, node: str, name: str) -> Path:
    if not source.is_dir():
        return source
    kept = source / node / KEPT
    if (kept / f"{name}{SUFFIX}").exists():
        return kept / f"{name}{SUFFIX}"
    others = [f"{p.parent.parent.name}.{p.stem}" for p in source.glob(f"*/{KEPT}/*{SUFFIX}")]
    has = f"it has kept {listed(sorted(others))}" if others else "it has kept nothing"
    hint = did_you_mean(f"{node}.{name}", others) or has
    raise UsageError(f"the run {source} has kept no '{node}.{name}' ({hint})")


def _described(file: Path) -> dict[str, Any]:
    try:
        with open_ordinary(file) as content:
            data = content.read()
    except OSError:  # its folder was removed, or closed to others
        return {"sha256": None, "bytes": None}
    return {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
