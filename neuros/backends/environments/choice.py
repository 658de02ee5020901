"""Chooses the Python of a container, among those of this machine; changes nothing."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from neuros.backends.containers import PACKAGE, ContainerFolder
from neuros.backends.environments.cache import Entry
from neuros.backends.environments.requirements import Requirements, read_requirements, unmet
from neuros.caching import KEY_LENGTH
from neuros.errors import EnvironmentFault
from neuros.installation.machine import NEWEST, OLDEST, clean_environment, dotted

Version = tuple[int, int]
FILE = ".python-version"
_VERSION = re.compile(r"(?:c?python-?)?(\d+)\.(\d+)(?:\.\d+)*")
_ASK = "import sys; print(sys.implementation.name, *sys.version_info[:2])"
_ANSWER_TIMEOUT_S = 10.0
HERE: Version = sys.version_info[:2]
_FORMAT = 1  # of what is made: another one makes all environments anew


def wanted_version(folder: Path) -> Version | None:
    """The version in a container's ``.python-version``, as pyenv and uv read it; or ``None``.

    Raises:
        EnvironmentFault: if there are no packages of ROS 2 for that Python.
    """
    file = folder / FILE
    try:
        rows = [row.strip() for row in file.read_text("utf-8").splitlines()]
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{file} cannot be read: {error}") from error
    text = next((row for row in rows if row and not row.startswith("#")), "")
    match = _VERSION.fullmatch(text)
    version = (int(match[1]), int(match[2])) if match else (0, 0)
    if not OLDEST <= version <= NEWEST:
        raise EnvironmentFault(
            f"{file} asks for Python {text!r}: name one that ROS 2 has packages for,"
            f" {dotted(OLDEST)} to {dotted(NEWEST)}"
        )
    return version


def find_python(version: Version, environ: Mapping[str, str]) -> Path | None:
    """A CPython of that version on this machine that runs, or ``None``."""
    for path in _candidates(f"python{dotted(version)}", environ):
        if os.access(path, os.X_OK) and _is_version(path, version, environ):
            return path
    return None


def _candidates(name: str, environ: Mapping[str, str]) -> Iterator[Path]:
    for folder in environ.get("PATH", os.defpath).split(os.pathsep):
        if folder:
            yield Path(folder) / name
    # A shim of pyenv is on the path, and refuses what its settings do not name.
    home = Path(environ.get("HOME") or "/")
    pyenv = Path(environ.get("PYENV_ROOT") or home / ".pyenv") / "versions"
    data = Path(environ.get("XDG_DATA_HOME") or home / ".local/share")
    uv = Path(environ.get("UV_PYTHON_INSTALL_DIR") or data / "uv/python")
    for installations in (pyenv, uv):
        yield from sorted(installations.glob(f"*/bin/{name}"), reverse=True)


def _is_version(path: Path, version: Version, environ: Mapping[str, str]) -> bool:
    try:
        answer = subprocess.run(
            [str(path), "-I", "-S", "-c", _ASK],
            env=clean_environment(environ),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_ANSWER_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return answer.stdout.split() == ["cpython", *map(str, version)]


@dataclass(frozen=True)
class Choice:
    """The Python and the packages of a container.

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
    """Choose for a container with a ``requirements.txt``.

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
    """Choose for a container that runs on this version of Python.

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
    """The requirements of NeuROS itself; empty if it is not installed here."""
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
