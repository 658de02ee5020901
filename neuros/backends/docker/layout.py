"""Paths that a node finds in its container; they do not depend on the machine."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

from neuros.project.model import Folders, NodeFile
from neuros.project.split import translated

ROOT = Path("/neuros")
FOLDERS = Folders(project=ROOT / "project", workspace=ROOT / "workspace", run=ROOT / "run")
"""What a node may read and write, as it sees it."""

MESSAGES = ROOT / "messages"
"""The built message packages of the run, each in a folder that has the same name here."""

LIBRARY = ROOT / "lib"
"""What ``PYTHONPATH`` names: NeuROS itself is in there, from the launcher's own installation."""

XAUTHORITY = ROOT / "xauthority"
"""The key to the user's display, where a node has one."""

DDS_FILE = ROOT / "fast_dds.xml"
"""The user's own settings of Fast DDS, where there are any."""

_INSIDE = re.compile(rf"(?<![\w/.]){ROOT}/({'|'.join(each.name for each in fields(Folders))})\b")


def inside(file: NodeFile) -> NodeFile:
    """A node with all paths as it sees them in its container."""
    return replace(
        file,
        node=translated(file.node, lambda path: _inside(path, file)),
        folders=FOLDERS,
        messages=tuple(_inside(path, file) for path in file.messages),
    )


def outside(file: NodeFile, folders: Folders, messages: Path = MESSAGES) -> NodeFile:
    """The inverse of :func:`inside`: the node with the paths of a machine with these folders.

    Args:
        messages: the folder with built message packages.
    """
    there = [(getattr(FOLDERS, e.name), getattr(folders, e.name)) for e in fields(Folders)]
    pairs = [*there, (MESSAGES, messages)]
    return replace(
        file,
        node=translated(file.node, lambda path: _moved(path, pairs)),
        folders=folders,
        messages=tuple(_moved(path, pairs) for path in file.messages),
    )


def as_here(text: str, folders: Folders) -> str:
    """Text of a node, with its paths replaced by those of this machine."""
    here = {each.name: str(getattr(folders, each.name)) for each in fields(Folders)}
    return _INSIDE.sub(lambda match: here[match[1]], text)


def _inside(path: Path, file: NodeFile) -> Path:
    """A path of this machine as a container sees it; what it does not see stays as it is."""
    here = file.folders
    mounted = [(here.project, FOLDERS.project), (here.workspace, FOLDERS.workspace)]
    mounted += [(python.parent, MESSAGES / python.parent.name) for python in file.messages]
    return _moved(path, mounted)


def _moved(path: Path, places: Sequence[tuple[Path, Path]]) -> Path:
    """A path in one of the first folders as one in the second; the innermost counts."""
    for here, there in sorted(places, key=lambda pair: -len(pair[0].parts)):
        if path.is_relative_to(here):
            return there / path.relative_to(here)
    return path
