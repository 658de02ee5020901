"""Finds the folder that describes a container, beside the project file or in NeuROS."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from neuros.distribution import CONTAINERS

FOLDER = "containers"
OWN_FOLDER = CONTAINERS
"""NeuROS's own."""

STANDARD = ("neuros_python", "neuros_mujoco", "neuros_nest")
"""Those that the examples need."""

_SLIP = 0.9
"""Similarity (difflib) of ``neuros_pyton`` and ``neuros_python``; of unlike names it is less."""
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")


@dataclass(frozen=True)
class ContainerFolder:
    """The folder of a container.

    Attributes:
        is_own: whether it is one of NeuROS's own, and none of the project.
    """

    name: str
    folder: Path
    is_own: bool

    @property
    def requirements(self) -> Path:
        """What pip is to install in it; the file need not exist."""
        return self.folder / "requirements.txt"


def bare_name(container: str) -> str:
    """``neuros_nest:latest`` as ``neuros_nest``: folders have no versions."""
    return container.removesuffix(":latest")


def folder_of(name: str, places: Iterable[Path]) -> Path | None:
    """The first folder of that name in ``places``; ``None`` where it can only be an image."""
    if not _NAME.fullmatch(name):
        return None
    return next((place / name for place in places if (place / name).is_dir()), None)


def find_container(name: str, project: Path, own: Path = OWN_FOLDER) -> ContainerFolder | None:
    """The folder of a container, or ``None``.

    ``containers/<name>/`` in the folder ``project`` goes before the one in ``own``.
    """
    name = bare_name(name)
    folder = folder_of(name, [project / FOLDER, own])
    return ContainerFolder(name, folder, folder.parent == own) if folder else None


def misspelt(container: str, project: Path, own: Path = OWN_FOLDER) -> str:
    """The folder that was probably meant where there is none of this name; empty if none was.

    A name without a folder may be that of an image, so only slips of the pen count.
    """
    name = bare_name(container)
    if not _NAME.fullmatch(name) or find_container(name, project, own) is not None:
        return ""
    known = [each.name for place in (project / FOLDER, own) for each in place.glob("*/")]
    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=_SLIP)), "")
