"""Where a node in a container finds things: the same paths on every machine."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

from neuros.project.model import Folders, NodeFile
from neuros.project.split import translated

ROOT = Path("/neuros")
FOLDERS = Folders(project=ROOT / "project", workspace=ROOT / "workspace", run=ROOT / "run")
"""What a node may read and write, as it sees it."""

LIBRARY = ROOT / "lib"
"""What ``PYTHONPATH`` names: NeuROS itself is in there, from the launcher's own installation."""

XAUTHORITY = ROOT / "xauthority"
"""The key to the user's display, where a node has one."""

DDS_FILE = ROOT / "fast_dds.xml"
"""The user's own settings of Fast DDS, where there are any."""

_INSIDE = re.compile(rf"(?<![\w/.]){ROOT}/({'|'.join(each.name for each in fields(Folders))})\b")


def inside(file: NodeFile) -> NodeFile:
    """The same node with all paths as it sees them in its container."""
    return replace(
        file,
        node=translated(file.node, lambda path: path_inside(path, file.folders)),
        folders=FOLDERS,
    )


def outside(file: NodeFile, folders: Folders) -> NodeFile:
    """The inverse of :func:`inside`: the node with the paths of a machine with these folders."""
    return replace(
        file, node=translated(file.node, lambda path: _path_outside(path, folders)), folders=folders
    )


def as_here(text: str, folders: Folders) -> str:
    """What a node has said, with the names that its paths have on this machine."""
    here = {each.name: str(getattr(folders, each.name)) for each in fields(Folders)}
    return _INSIDE.sub(lambda match: here[match[1]], text)


def path_inside(path: Path, folders: Folders) -> Path:
    """A path of this machine as a container sees it; what it does not see stays as it is."""
    mounted = ((folders.project, FOLDERS.project), (folders.workspace, FOLDERS.workspace))
    for here, there in sorted(mounted, key=lambda pair: -len(pair[0].parts)):
        if path.is_relative_to(here):
            return there / path.relative_to(here)
    return path


def _path_outside(path: Path, folders: Folders) -> Path:
    for each in fields(Folders):
        there: Path = getattr(FOLDERS, each.name)
        if path.is_relative_to(there):
            return Path(getattr(folders, each.name)) / path.relative_to(there)
    return path
