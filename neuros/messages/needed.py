"""The message packages of a run: which ones it needs, and whether they are built."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from graphlib import CycleError
from importlib.util import find_spec
from pathlib import Path

from neuros.errors import Problem
from neuros.installation.progress import Progress
from neuros.messages.building import Step, build
from neuros.messages.cache import Built
from neuros.messages.workspace import Workspaces, cycle_problem
from neuros.project.model import Node


class Messages:
    """Packages of workspaces, with all that they need, in the order of their building.

    Args:
        names: of packages; those that are in no workspace are left out.
    """

    def __init__(self, workspaces: Workspaces, names: Iterable[str]) -> None:
        self._workspaces = workspaces
        self._steps: list[Step] = []
        wanted = sorted(names)
        self._problems = list(workspaces.problems if wanted else workspaces.own_problems)
        if not wanted:
            return
        try:
            builds = workspaces.builds(wanted)
        except CycleError as error:
            self._problems.append(cycle_problem(workspaces, error))
            return
        by_name = {built.package: built for built in builds}
        for built in builds:
            needs = workspaces.closure(workspaces.needs(built.package))
            package = workspaces.packages[built.package]
            is_current = partial(self._is_current, built)
            self._steps.append(
                Step(package, built, [by_name[need.name] for need in needs], is_current)
            )

    @classmethod
    def of_nodes(cls, nodes: Iterable[Node], workspaces: Workspaces) -> Messages:
        """What nodes need: all packages of the project, and the shared ones that ports name."""
        ports = (port for node in nodes for port in (*node.inputs, *node.outputs))
        used = {port.type.partition("/")[0] for port in ports}
        # Shared ones are not looked for where everything comes with ROS, as it mostly does.
        names = used if any(find_spec(package) is None for package in used) else ()
        return cls(workspaces, {*workspaces.own, *names})

    @property
    def built(self) -> list[Built]:
        """Where each package is, or will be."""
        return [step.built for step in self._steps]

    @property
    def paths(self) -> tuple[Path, ...]:
        """What has to be on Python's path."""
        return tuple(built.python for built in self.built)

    @property
    def is_made(self) -> bool:
        """Whether everything is built."""
        return all(built.is_there for built in self.built)

    def problems(self) -> list[Problem]:
        """What is wrong in the files of packages; what is built had nothing wrong with it."""
        missing = [step.package for step in self._steps if not step.built.is_there]
        if not missing:
            return self._problems
        # Imported here: most of the time everything is built.
        from neuros.messages.checking import check

        return [*self._problems, *check(missing, self._workspaces)]

    def note_use(self) -> None:
        """Keep it all from being removed as unused."""
        for built in self.built:
            built.note_use()

    def make(self, progress: Progress, environment: Mapping[str, str]) -> None:
        """Build what is missing.

        Args:
            environment: of the programs that this starts.

        Raises:
            EnvironmentFault: with a sentence for the user.
        """
        build(self._steps, self._workspaces.ros, progress, environment)

    def _is_current(self, built: Built) -> bool:
        return built in self._workspaces.builds([built.package])

    def describe(self) -> list[str]:
        """One line per package."""
        return [
            f"message package {step.package.name}"
            f"{'' if step.built.is_there else ', which launching builds first'}:"
            f" {step.built.folder}"
            for step in self._steps
        ]
