"""Which Python a container needs: decided from its folder, without changing anything."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import neuros
from neuros.caching import KEY_LENGTH
from neuros.installation.machine import dotted
from neuros.launch.containers import ContainerFolder
from neuros.launch.environments.cache import Entry
from neuros.launch.environments.interpreters import FILE, Version, find_python, wanted_version
from neuros.launch.environments.requirements import Requirements, read_requirements, unmet

HERE: Version = sys.version_info[:2]
PACKAGE = Path(neuros.__file__).resolve().parent
_FORMAT = 1  # of what is made: another one makes all environments anew


@dataclass(frozen=True)
class Choice:
    """What a container needs.

    Attributes:
        version: the Python that it is to run on.
        entry: its place in the cache.
        lacks: what this environment lacks, in words, as far as that had to be found out.
        base: the interpreter to make its environment with; ``None`` if nothing is to be made.
        notice: what the user should know, or empty.
    """

    container: ContainerFolder
    requirements: Requirements
    version: Version
    entry: Entry
    lacks: tuple[str, ...] = ()
    base: Path | None = None
    notice: str = ""

    @property
    def is_layered(self) -> bool:
        """Whether its environment lies on top of this one, and has only what differs."""
        return self.version == HERE

    @property
    def path(self) -> Path:
        """Its Python, which may have to be made first."""
        if self.base is not None:
            return self.entry.future_python
        return self.entry.python() or Path(sys.executable)

    def settle(self) -> None:
        """Remember for later starts that it is in use, or that this very Python does.

        Raises ``OSError``.
        """
        if self.base is not None:
            return
        if self.entry.python() is None:
            self.entry.settle(is_here=True)
        self.entry.note_use()


def choose(container: ContainerFolder, cache: Path, environ: Mapping[str, str]) -> Choice:
    """What a container with a ``requirements.txt`` needs.

    Raises:
        EnvironmentFault: if its files cannot be read, or ask for a Python without ROS 2.
    """
    wanted = wanted_version(container.folder)
    if wanted is None or wanted == HERE:
        return choose_here(container, cache)
    requirements = read_requirements(container.requirements)
    entry = _entry(container, requirements, cache, wanted)
    if entry.python():
        return Choice(container, requirements, wanted, entry)
    if base := find_python(wanted, environ):
        return Choice(container, requirements, wanted, entry, base=base)
    notice = (
        f"container '{container.name}' prefers Python {dotted(wanted)} ({container.folder / FILE}),"
        f" which is not on this machine: it gets Python {dotted(HERE)}"
    )
    return replace(choose_here(container, cache), notice=notice)


def choose_here(container: ContainerFolder, cache: Path) -> Choice:
    """The same where it runs on this version of Python in any case.

    Raises:
        EnvironmentFault: if its files cannot be read.
    """
    requirements = read_requirements(container.requirements)
    entry = _entry(container, requirements, cache, HERE)
    if entry.python():
        return Choice(container, requirements, HERE, entry)
    # The files of NeuROS's own containers say with exact versions what goes into images; which
    # versions are here is up to install.py.
    lacks = tuple(unmet(requirements, any_version=container.is_own))
    base = Path(getattr(sys, "_base_executable", sys.executable)) if lacks else None
    return Choice(container, requirements, HERE, entry, lacks, base)


def own_needs() -> list[str]:
    """What NeuROS itself needs, as requirements; empty if it is not installed here."""
    try:
        needs = importlib.metadata.requires("neuros") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [need for need in needs if "extra ==" not in need]


def packages_here() -> list[Path]:
    """The folders of this Python with installed packages, those that are found first first."""
    return [Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]


def _entry(
    container: ContainerFolder, requirements: Requirements, cache: Path, version: Version
) -> Entry:
    what = [_FORMAT, container.is_own, requirements.digest, version, str(PACKAGE), own_needs()]
    if version == HERE:
        what += [sys.executable, sys.version, _installed_here()]
    key = hashlib.sha256(json.dumps(what).encode()).hexdigest()
    return Entry(cache / f"{container.name}-{key[:KEY_LENGTH]}")


def _installed_here() -> list[str]:
    """Names and versions of what is installed, from the names of folders only: it has to be quick.

    An environment on top of this one is no longer the same when anything here changes.
    """
    return [
        f"{folder}/{name}"
        for folder in packages_here()
        if folder.is_dir()
        for name in sorted(os.listdir(folder))
        if name.endswith((".dist-info", ".egg-info"))
    ]
