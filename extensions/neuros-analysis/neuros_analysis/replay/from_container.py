"""Paths, versions and errors of a node that ran in a container and is replayed without one."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuros.api.run_record import PastRun
from neuros.errors import EnvironmentFault, NeurosError
from neuros.ports import BackEnd
from neuros.project.model import Folders, NodeFile
from neuros.registry import BACK_ENDS

_FEW = 5
_INSTALLERS = {"pip", "setuptools", "wheel"}  # nothing that a node computes depends on them


def ran_in_container(run: PastRun) -> bool:
    """Whether the nodes of a run had Pythons of their own, as in containers."""
    return _back_end(run).has_own_pythons


def as_on_this_machine(run: PastRun, file: NodeFile, workspace: Path, messages: Path) -> NodeFile:
    """``node.json`` with the paths of this machine; ``file`` has the paths of the run.

    Args:
        messages: the folder with built message packages.
    """
    folders = Folders(Path(run.record["file"]).parent, workspace, run.folder)
    return _back_end(run).on_this_machine(file, folders, messages)


def _back_end(run: PastRun) -> BackEnd:
    """Raises ``UsageError`` if its distribution is not installed, ``EnvironmentFault``."""
    return BACK_ENDS.load(run.record["backend"])


def not_here(run: PastRun, name: str, cause: object) -> EnvironmentFault:
    """The error for a module or file that the node had in its run, and this machine lacks."""
    return EnvironmentFault(
        f"replay: in {run.folder} '{name}' ran in {_back_end(run).place}; a replay runs as a"
        f" process of this machine, which lacks something: {cause}"
    )


def missing_module(failure: NeurosError | None) -> str:
    """The advice for a failure if the node lacks a module, else an empty text."""
    cause = None if failure is None else failure.__cause__
    if not isinstance(cause, ModuleNotFoundError):
        return ""
    return (
        f"{cause}: install it for {sys.executable}, or name it in the requirements.txt of the"
        " container"
    )


def note_on_versions(run: PastRun, name: str, here: Mapping[str, Any]) -> str:
    """The packages of which the image of a node had another version; empty if there are none.

    Args:
        here: as from :func:`neuros.recording.provenance.python_versions`.
    """
    versions = run.record.get("versions")
    if versions is None:  # the launcher was killed
        return ""
    there = versions["nodes"].get(name, versions)  # not recorded if they are those of the launcher
    had = {"Python": there["python"], **there["packages"]}
    has = {"Python": here["python"], **here["packages"]}
    rows = [
        f"{what} {version} (here {has[what]})"
        for what, version in had.items()
        if what not in _INSTALLERS and has.get(what, version) != version
    ]
    if not rows:
        return ""
    more = f" and {len(rows) - _FEW} more" if len(rows) > _FEW else ""
    place = _back_end(run).place_in(run.record, name)
    return f"the node ran in {place} with {', '.join(rows[:_FEW])}{more}"
