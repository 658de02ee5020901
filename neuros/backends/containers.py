"""Folders of containers, beside the project file or in NeuROS, and the recipes of images in them.

A recipe is a folder ``containers/<name>`` with a ``Dockerfile``, or with a ``requirements.txt``
only. The project's own, beside its project file, come before NeuROS's. Nothing here asks an engine.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from neuros.backends.docker.dockerfile import images_in
from neuros.distribution import CONTAINERS
from neuros.errors import EnvironmentFault

FOLDER = "containers"
OWN_FOLDER = CONTAINERS
"""NeuROS's own."""

STANDARD = ("neuros_python", "neuros_mujoco", "neuros_nest")
"""Those that the examples need."""

BASE = "neuros_python"
"""The recipe that makes an image with Python one that runs nodes."""

BASE_ARGUMENT = "BASE_IMAGE"

_NOTHING: Mapping[str, str] = MappingProxyType({})
_FROM_REQUIREMENTS = f"""\
ARG {BASE_ARGUMENT}={BASE}
FROM ${{{BASE_ARGUMENT}}}
USER 0
COPY requirements.txt /tmp/requirements.txt
RUN /opt/neuros/bin/pip install --no-cache-dir -r /tmp/requirements.txt
USER 1000:1000
"""

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
        """The requirements of its Python; the file need not exist."""
        return self.folder / "requirements.txt"


def bare_name(container: str) -> str:
    """``neuros_nest:latest`` as ``neuros_nest``: folders have no versions."""
    return container.removesuffix(":latest")


def folder_of(name: str, places: Iterable[Path]) -> Path | None:
    """The first folder of that name in ``places``; ``None`` where it can only be an image."""
    if not _NAME.fullmatch(name):
        return None
    folders = (place / name for place in places)
    return next((each for each in folders if os.path.isdir(each)), None)  # a name may be too long


def find_container(name: str, project: Path, own: Path = OWN_FOLDER) -> ContainerFolder | None:
    """The folder of a container, or ``None``.

    ``containers/<name>/`` in the folder ``project`` goes before the one in ``own``.
    """
    name = bare_name(name)
    folder = folder_of(name, [project / FOLDER, own])
    return ContainerFolder(name, folder, folder.parent == own) if folder else None


def why_no_container(container: str, project: Path, own: Path = OWN_FOLDER) -> tuple[str, str]:
    """The mistake in a name without a folder, and a hint; empty for a valid name.

    A name with a version may be that of an image: only a name close to a folder's is a mistake.
    """
    name = bare_name(container)
    if not _NAME.fullmatch(name) or find_container(name, project, own) is not None:
        return "", ""
    known = [each.name for place in (project / FOLDER, own) for each in sorted(place.glob("*/"))]
    cutoff = 0.6 if name == container else _SLIP
    meant = difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    hint = f"did you mean '{meant[0]}'?" if meant else ""
    if name == container and not meant:
        hint = f"there are {', '.join(known)}; an image of your own has a version: '{name}:latest'"
    return (f"there is no container '{container}'", hint) if hint else ("", "")


@dataclass(frozen=True)
class Recipe:
    """A folder from which an image can be built.

    Attributes:
        name: of the container.
        folder: with the ``Dockerfile``, ``requirements.txt``, and other files for the image.
        dockerfile: its text; generated where there is only a ``requirements.txt``.
        parents: the recipes among the images in its ``FROM`` lines.
        digest: of its files and those of its parents.
    """

    name: str
    folder: Path
    dockerfile: str
    parents: tuple[Recipe, ...]
    digest: str

    @property
    def is_own(self) -> bool:
        """Whether it is one of NeuROS's."""
        return self.folder.parent == OWN_FOLDER

    def takes(self, base: str) -> bool:
        """Whether ``BASE_IMAGE=base`` makes it begin from ``base``."""
        return base in images_in(self.dockerfile, {BASE_ARGUMENT: base})

    def parents_on(self, base: str | None) -> list[Recipe]:
        """The parents where ``base`` replaces the default of ``BASE_IMAGE``."""
        if base is None:
            return list(self.parents)
        names = {bare_name(name) for name in images_in(self.dockerfile, {BASE_ARGUMENT: base})}
        return [parent for parent in self.parents if parent.name in names]

    @property
    def tags(self) -> list[str]:
        """The names of its image; NeuROS's own have ``latest``, too, for use by hand."""
        own = [f"{self.name}:latest"] if self.is_own else []
        return [f"{self.name}:{self.digest[:12]}", *own]

    def __str__(self) -> str:
        return str(self.folder)


def find_recipe(
    container: str, project_folder: Path | None = None, own_folder: Path = OWN_FOLDER
) -> Recipe | None:
    """The recipe of a container, with its parents; ``None`` where it can only be an image.

    Raises:
        EnvironmentFault: for a folder that holds none, or recipes that go round in a circle.
    """
    places = [own_folder] if project_folder is None else [project_folder / FOLDER, own_folder]
    return _find(bare_name(container), places, ())


def _find(name: str, places: list[Path], children: tuple[str, ...]) -> Recipe | None:
    folder = folder_of(name, places)
    if folder is None:
        return None
    if name in children:
        raise EnvironmentFault(
            f"{folder}: the images begin from each other: {' -> '.join([*children, name])}"
        )
    try:
        text = (folder / "Dockerfile").read_text("utf-8")
    except FileNotFoundError:
        if not (folder / "requirements.txt").is_file():
            raise EnvironmentFault(
                f"{folder}: there is neither a Dockerfile nor a requirements.txt in it"
            ) from None
        text = _FROM_REQUIREMENTS
    except (OSError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{folder}/Dockerfile cannot be read: {error}") from error
    parents = tuple(
        parent
        for image in images_in(text)
        if (parent := _find(bare_name(image), places, (*children, name)))
    )
    # An image without rclpy gets the base on top, so the base is an ancestor of all.
    base = _find(BASE, places[-1:], ()) if name != BASE and not parents else None
    return Recipe(name, folder, text, parents, _digest(folder, text, [*parents, base]))


def in_order(recipes: Iterable[Recipe], bases: Mapping[str, str] = _NOTHING) -> list[Recipe]:
    """The recipes and all their parents, each once, parents first.

    ``bases`` are images by container name: what the user wants instead of the Dockerfile's.
    """
    found: dict[Path, Recipe] = {}

    def add(recipe: Recipe) -> None:
        for parent in recipe.parents_on(bases.get(recipe.name)):
            add(parent)
        found.setdefault(recipe.folder, recipe)

    for recipe in recipes:
        add(recipe)
    return list(found.values())


def names_in(folder: Path) -> list[str]:
    """The containers for which a folder ``containers`` has recipes."""
    if not folder.is_dir():
        return []
    return sorted(
        each.name
        for each in folder.iterdir()
        if any((each / file).is_file() for file in ("Dockerfile", "requirements.txt"))
    )


def _digest(folder: Path, dockerfile: str, parents: Iterable[Recipe | None]) -> str:
    """Digest of the names, contents and rights to execute of the files in a folder."""
    whole = hashlib.sha256(dockerfile.encode())
    for file in files_of(folder):
        whole.update(f"\0{file.relative_to(folder)}\0{file.stat().st_mode & 0o111}\0".encode())
        whole.update(hashlib.sha256(file.read_bytes()).digest())
    for parent in parents:
        whole.update(parent.digest.encode() if parent else b"")
    return whole.hexdigest()


def files_of(folder: Path) -> Iterator[Path]:
    """The files that go to the engine, in a fixed order."""
    for file in sorted(folder.rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            yield file


def for_all(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    """Make an entry of an archive readable for all, and writable only for root."""
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    entry.mode = 0o755 if entry.mode & 0o111 else 0o644
    return entry
