"""The Pythons of a run: one choice per container, all made before anything starts."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.installation.machine import dotted
from neuros.installation.progress import Progress
from neuros.launch.containers import ContainerFolder, find_container
from neuros.launch.environments.cache import cache_folder, sweep
from neuros.launch.environments.choice import Choice, choose, choose_here
from neuros.launch.environments.making import make
from neuros.launch.environments.requirements import unmet
from neuros.project.model import Node


class Pythons:
    """What the nodes run on whose containers have a ``requirements.txt``.

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
        """What the user should know."""
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
