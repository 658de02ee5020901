"""What is wrong in packages: in their message files, and in how they fit together."""

from __future__ import annotations

from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from neuros.errors import Problem
from neuros.messages.definition import Use, package_name_mistake, read_definition
from neuros.messages.package import MANIFEST, Package, problem_at
from neuros.messages.workspace import Workspaces
from neuros.project.suggest import did_you_mean


def check(packages: Sequence[Package], workspaces: Workspaces) -> list[Problem]:
    """Everything that is wrong in the files of these packages."""
    problems: list[Problem] = []
    for package in packages:
        if workspaces.ros.has(package.name):
            text = f"found the name '{package.name}' of a package of ROS, expected another"
            problems.append(problem_at(package.folder / MANIFEST, text))
            continue
        if text := package_name_mistake(package.name):
            problems.append(problem_at(package.folder / MANIFEST, text))
        problems += _check_package(package, workspaces)
    return problems


def _check_package(package: Package, workspaces: Workspaces) -> list[Problem]:
    problems: list[Problem] = []
    contained: dict[str, set[str]] = {}
    for relative in package.files:
        file = package.folder / relative
        definition = read_definition(package.name, file)
        problems += definition.problems
        for use in definition.uses:
            if problem := _unknown(package, file, use, workspaces):
                problems.append(problem)
        if file.suffix == ".msg":
            names = {use.type.partition("/") for use in definition.uses}
            contained[file.stem] = {name for of, _, name in names if of == package.name}
    return problems or _circles(package, contained)


def _unknown(package: Package, file: Path, use: Use, workspaces: Workspaces) -> Problem | None:
    of, _, name = use.type.partition("/")
    messages = workspaces.messages(of)
    if messages is None:
        messages = workspaces.ros.messages(of)
    if messages is None:
        known = {*workspaces.packages, *workspaces.ros.message_packages()}
        text = f"found '{use.type}', expected a message of a package that is here"
        hint = did_you_mean(of, known) or f"there is no package '{of}'"
    elif name not in messages:
        text, hint = (
            f"found '{use.type}', expected a message of '{of}'",
            did_you_mean(name, messages),
        )
    elif of != package.name and of not in package.dependencies:
        text = f"found '{use.type}', expected <depend>{of}</depend> in {MANIFEST}"
        hint = "colcon would not find it either"
    else:
        return None
    return problem_at(file, text, use.line, use.column, hint)


def _circles(package: Package, contained: dict[str, set[str]]) -> list[Problem]:
    try:
        TopologicalSorter(contained).prepare()
    except CycleError as error:
        circle = error.args[1]
        text = f"found a message that contains itself: {' -> '.join(circle)}"
        return [problem_at(package.folder / "msg" / f"{circle[0]}.msg", text)]
    return []
