"""Where a container is described: a folder of its name, beside the project file or in NeuROS."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

FOLDER = "containers"
_NAME = re.compile(r"\w[\w.-]*")
_OWN = Path(__file__).resolve().parents[2] / FOLDER


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


def find_container(name: str, project: Path, own: Path = _OWN) -> ContainerFolder | None:
    """The folder of the container of that name, or ``None``: it is an image from elsewhere.

    ``containers/<name>/`` in the folder ``project`` goes before the one in ``own``. A tag
    (``name:tag``) plays no part in it.
    """
    name = name.partition(":")[0]
    if not _NAME.fullmatch(name):  # it is the address of an image, with slashes
        return None
    for folder, is_own in ((project / FOLDER / name, False), (own / name, True)):
        if folder.is_dir():
            return ContainerFolder(name, folder, is_own)
    return None
