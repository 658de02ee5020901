"""Python of each container, for nodes that run as processes.

A node runs on this Python if this environment satisfies the ``requirements.txt`` of its container.
Every other container gets a virtual environment, made before anything starts
(:mod:`neuros.backends.virtual_environments`). Choosing changes nothing on the disk.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from neuros.backends.containers import ContainerFolder, find_container
from neuros.backends.virtual_environments import (
    HERE,
    CachedEnvironment,
    Choice,
    Requirements,
    Version,
    cache_folder,
    make,
    own_needs,
    packages_here,
    read_requirements,
    unmet,
)
from neuros.caching import KEY_LENGTH, sweep
from neuros.distribution import PACKAGE
from neuros.errors import EnvironmentFault
from neuros.installation.machine import NEWEST, OLDEST, answer_of, clean_environment, dotted
from neuros.installation.progress import Progress
from neuros.project.model import Node

FILE = ".python-version"
_VERSION = re.compile(r"(?:c?python-?)?(\d+)\.(\d+)(?:\.\d+)*")
_ASK = "import sys; print(sys.implementation.name, *sys.version_info[:2])"
_ANSWER_TIMEOUT_S = 10.0
_FORMAT = 2  # of environments: another number makes all anew


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
            f"{file} asks for Python {text!r}: name a version that ROS 2 has packages for,"
            f" {dotted(OLDEST)} to {dotted(NEWEST)}"
        )
    return version


def find_python(version: Version, environ: Mapping[str, str]) -> Path | None:
    """A CPython of that version on this machine that runs, or ``None``."""
    name = f"python{dotted(version)}"
    folders = environ.get("PATH", os.defpath).split(os.pathsep)
    candidates = [Path(folder) / name for folder in folders if folder]
    # A shim of pyenv on the path refuses versions that pyenv's settings do not name.
    home = Path(environ.get("HOME") or "/")
    pyenv = Path(environ.get("PYENV_ROOT") or home / ".pyenv") / "versions"
    data = Path(environ.get("XDG_DATA_HOME") or home / ".local/share")
    uv = Path(environ.get("UV_PYTHON_INSTALL_DIR") or data / "uv/python")
    for installations in (pyenv, uv):
        candidates += sorted(installations.glob(f"*/bin/{name}"), reverse=True)
    for path in candidates:
        if not os.access(path, os.X_OK):
            continue
        command = [str(path), "-I", "-S", "-c", _ASK]
        answer = answer_of(command, clean_environment(environ), _ANSWER_TIMEOUT_S)
        if answer and answer.stdout.split() == ["cpython", *map(str, version)]:
            return path
    return None


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
    # NeuROS's own containers name exact versions for their images; the versions here are those
    # of the installation.
    lacks = tuple(unmet(requirements, any_version=container.is_own))
    base = Path(getattr(sys, "_base_executable", sys.executable)) if lacks else None
    return Choice(container, requirements, HERE, entry, lacks, base)


def _entry(
    container: ContainerFolder, requirements: Requirements, cache: Path, version: Version
) -> CachedEnvironment:
    # An environment on top of this one is no longer the same when a package here changes. Names of
    # folders hold names and versions, and are quick to list.
    here = [
        f"{folder}/{name}"
        for folder in packages_here()
        if folder.is_dir()
        for name in sorted(os.listdir(folder))
        if name.endswith((".dist-info", ".egg-info"))
    ]
    parts = [_FORMAT, container.is_own, requirements.digest, version, str(PACKAGE), own_needs()]
    parts += [name for name in here if os.path.basename(name).startswith("neuros_")]  # extensions
    if version == HERE:
        parts += [sys.executable, sys.version, here]
    key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    return CachedEnvironment(cache / f"{container.name}-{key[:KEY_LENGTH]}")


class Pythons:
    """Pythons of the nodes whose containers have a ``requirements.txt``.

    Args:
        choices: by the name of the node; nodes of one container share theirs.
    """

    def __init__(self, choices: Mapping[str, Choice]) -> None:
        self._choices = choices

    @classmethod
    def choose(cls, nodes: Sequence[Node], project: Path, environ: Mapping[str, str]) -> Pythons:
        """Choose for the nodes of the project in the folder ``project``.

        Raises:
            EnvironmentFault: with all mistakes in the folders of containers.
        """
        cache, faults = cache_folder(environ), []
        choices: dict[str, Choice] = {}
        for container, names in _containers(nodes, project):
            try:
                choices |= dict.fromkeys(names, choose(container, cache, environ))
            except EnvironmentFault as fault:
                faults.append(str(fault))
        if faults:
            raise EnvironmentFault("\n".join(faults))
        return cls(choices)

    @property
    def paths(self) -> Mapping[str, Path]:
        """The Python of each node that does not run on this Python."""
        pythons = {name: choice.path for name, choice in self._choices.items()}
        return {name: path for name, path in pythons.items() if path != Path(sys.executable)}

    @property
    def notices(self) -> list[str]:
        return [choice.notice for choice in self._each() if choice.notice]

    @property
    def is_made(self) -> bool:
        return not any(choice.base for choice in self._each())

    def record_use(self) -> None:
        """Record the use of each choice, where the cache can be written."""
        for choice in self._each():
            with contextlib.suppress(OSError):
                choice.record_use()

    def make(self, progress: Progress, run_environment: Mapping[str, str]) -> None:
        """Make missing environments; ``run_environment`` is added to that of pip, uv and venv.

        Raises:
            EnvironmentFault: with a sentence for each container for which that failed.
        """
        faults = []
        for choice in self._each():
            if choice.base is None:
                continue
            try:
                make(choice, progress, run_environment)
                sweep(choice.entry.folder.parent, CachedEnvironment)
            except EnvironmentFault as fault:
                faults.append(str(fault))
        if faults:
            raise EnvironmentFault("\n".join(faults))

    def describe(self) -> list[str]:
        """One line per container that gets a Python of its own."""
        return [
            f"container {choice.container.name}: Python {dotted(choice.version)}, an environment"
            f" {'that launching makes first' if choice.base else 'of its own'}:"
            f" {choice.entry.folder}"
            for choice in self._each()
            if choice.path != Path(sys.executable)
        ]

    def _each(self) -> Iterable[Choice]:
        return {id(choice): choice for choice in self._choices.values()}.values()


def require_one_python(nodes: Sequence[Node], project: Path, environ: Mapping[str, str]) -> None:
    """Check that this Python satisfies all nodes, which share one process.

    Raises:
        EnvironmentFault: with the missing packages, and the remedies.
    """
    problems = []
    for container, names in _containers(nodes, project):
        choice = choose_here(container, cache_folder(environ))
        if choice.path == Path(sys.executable):
            with contextlib.suppress(OSError):
                choice.record_use()
            continue
        which = f"node{'' if len(names) == 1 else 's'} {', '.join(names)}"
        lacks = choice.lacks or unmet(choice.requirements, any_version=container.is_own)
        problems.append(f"container '{container.name}' ({which}) needs {', '.join(lacks)}")
    if problems:
        raise EnvironmentFault(
            f"{'; '.join(problems)}: in one process all nodes share one Python; use --backend"
            f" process, or install that for {sys.executable}"
        )


def _containers(
    nodes: Sequence[Node], project: Path
) -> Iterator[tuple[ContainerFolder, Sequence[str]]]:
    """The containers that have a ``requirements.txt``, and the names of their nodes."""
    names: dict[str, list[str]] = {}
    for node in nodes:
        names.setdefault(node.container, []).append(node.name)
    for name, of_nodes in names.items():
        container = find_container(name, project)
        if container and container.requirements.is_file():
            yield container, of_nodes
