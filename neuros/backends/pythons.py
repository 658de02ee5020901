"""Python of each container, for nodes that run as processes.

A node whose container has a ``requirements.txt`` that this environment satisfies runs on this
Python. Every other container gets a virtual environment of its own, made before anything starts
(:mod:`neuros.backends.virtual_environments`). What is chosen here changes nothing.
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
    Choice,
    Entry,
    Requirements,
    Version,
    cache_folder,
    make,
    own_needs,
    packages_here,
    read_requirements,
    sweep,
    unmet,
)
from neuros.caching import KEY_LENGTH
from neuros.distribution import PACKAGE
from neuros.errors import EnvironmentFault
from neuros.installation.machine import NEWEST, OLDEST, answer_of, clean_environment, dotted
from neuros.installation.progress import Progress
from neuros.project.model import Node

FILE = ".python-version"
_VERSION = re.compile(r"(?:c?python-?)?(\d+)\.(\d+)(?:\.\d+)*")
_ASK = "import sys; print(sys.implementation.name, *sys.version_info[:2])"
_ANSWER_TIMEOUT_S = 10.0
_FORMAT = 2  # of what is made: another one makes all environments anew


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
    command = [str(path), "-I", "-S", "-c", _ASK]
    answer = answer_of(command, clean_environment(environ), _ANSWER_TIMEOUT_S)
    return answer is not None and answer.stdout.split() == ["cpython", *map(str, version)]


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
    # versions are here is up to what has installed NeuROS.
    lacks = tuple(unmet(requirements, any_version=container.is_own))
    base = Path(getattr(sys, "_base_executable", sys.executable)) if lacks else None
    return Choice(container, requirements, HERE, entry, lacks, base)


def _entry(
    container: ContainerFolder, requirements: Requirements, cache: Path, version: Version
) -> Entry:
    here = _installed_here()
    what = [_FORMAT, container.is_own, requirements.digest, version, str(PACKAGE), own_needs()]
    what += [name for name in here if os.path.basename(name).startswith("neuros_")]  # extensions
    if version == HERE:
        what += [sys.executable, sys.version, here]
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


class Pythons:
    """Pythons of the nodes whose containers have a ``requirements.txt``.

    Args:
        choices: by the name of the node; nodes of one container share theirs.
    """

    def __init__(self, choices: Mapping[str, Choice]) -> None:
        self._choices = choices

    @classmethod
    def choose(cls, nodes: Sequence[Node], project: Path, environ: Mapping[str, str]) -> Pythons:
        """Decide for the nodes of a project in the folder ``project``; changes nothing.

        Raises:
            EnvironmentFault: with all that is wrong in the folders of containers.
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
        """The Python of each node that does not run on this very one."""
        pythons = {name: choice.path for name, choice in self._choices.items()}
        return {name: path for name, path in pythons.items() if path != Path(sys.executable)}

    @property
    def notices(self) -> list[str]:
        """Notices for the user."""
        return [choice.notice for choice in self._each() if choice.notice]

    @property
    def is_made(self) -> bool:
        """Whether everything is there."""
        return not any(choice.base for choice in self._each())

    def note_use(self) -> None:
        """Remember what was found out, as far as the cache can be written to."""
        for choice in self._each():
            with contextlib.suppress(OSError):
                choice.settle()

    def make(self, progress: Progress, run_environment: Mapping[str, str]) -> None:
        """Make what is missing; ``run_environment`` is added to that of the programs it starts.

        Raises:
            EnvironmentFault: with a sentence for each container for which that failed.
        """
        faults = []
        for choice in self._each():
            if choice.base is None:
                continue
            try:
                make(choice, progress, run_environment)
                sweep(choice.entry.folder.parent)
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
    """Check that this very Python does for all nodes, as it must where they share a process.

    Raises:
        EnvironmentFault: with what is missing, and the ways out.
    """
    problems = []
    for container, names in _containers(nodes, project):
        choice = choose_here(container, cache_folder(environ))
        if choice.path == Path(sys.executable):
            with contextlib.suppress(OSError):
                choice.settle()
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
