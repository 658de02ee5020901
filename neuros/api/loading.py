"""Loading of a project, together with the message packages that it sees."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from neuros.backends.containers import find_container, misspelt
from neuros.distribution import WORKSPACE, install_command
from neuros.errors import Problem, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.project.load import Loaded, load_project
from neuros.project.message_types import unknown_type
from neuros.project.model import NETWORK, NETWORK_MODULE, Node, Project
from neuros.project.paths import why_no_module
from neuros.project.scanner import display_name, place_of
from neuros.recording.provenance import seeds

_LONG_BYTES = 1 << 20
"""A file of a container's folder from this size on is data, not a recipe."""


def load_with_messages(
    path: Path,
    overrides: Sequence[str] = (),
    namespace: str | None = None,
    remap: Sequence[str] = (),
    *,
    reads_plugins: bool = True,
) -> tuple[Loaded, Messages]:
    """Load the project and find its message packages; ``reads_plugins``: look into plugins, too.

    Raises:
        ProjectError: with all its problems, and those of its message files.
    """
    workspaces = workspaces_of(path)
    try:
        loaded = load_project(
            path,
            workspace=WORKSPACE,
            overrides=overrides,
            packages=workspaces,
            namespace=namespace,
            remap=remap,
            reads_plugins=reads_plugins,
        )
    except ProjectError as error:
        problems = Messages(workspaces, workspaces.own).problems()
        raise ProjectError([*error.problems, *problems]) from None
    messages = Messages.of_nodes(loaded.project.nodes, workspaces)
    if problems := messages.problems():
        raise ProjectError(problems)
    nodes = loaded.project.nodes if reads_plugins else ()
    if problems := [problem for node in nodes for problem in _network_problems(node)]:
        raise ProjectError(problems)
    doubts = (
        *_misspelt(loaded),
        *_unknown_types(loaded, workspaces),
        *_unknown_plugins(loaded),
        *_network_doubts(loaded),
    )
    return replace(loaded, warnings=(*loaded.warnings, *doubts)), messages


def seed_variables(project: Project, seed: int) -> dict[str, dict[str, str]]:
    """By node, the variables of its environment that give it this seed.

    A seed is a variable in the ``environment`` of a node whose name contains SEED.

    Raises:
        UsageError: if no node has one.
    """
    found = seeds(project.nodes)
    if not found:
        raise UsageError(
            f"seed {seed}: no node of {project.name} has an environment variable with SEED in its"
            " name: add the one that its plugin reads to its environment"
        )
    return {name: dict.fromkeys(variables, str(int(seed))) for name, variables in found.items()}


def _misspelt(loaded: Loaded) -> Iterator[Problem]:
    """The containers that are probably meant to be others."""
    for node in loaded.project.nodes:
        if meant := misspelt(node.container, loaded.project.folder):
            text = f"there is no container '{node.container}'"
            yield Problem(f"node '{node.name}'", 0, 0, "", text, f"did you mean '{meant}'?")


def _unknown_types(loaded: Loaded, workspaces: Workspaces) -> Iterator[Problem]:
    """Message types that are not here, nor named in the folder of the node's container."""
    for node in loaded.project.nodes:
        container = find_container(node.container, loaded.project.folder)
        if container is None or container.is_own:  # an image of the user's; or it was a mistake
            continue
        for side, ports in (("inputs", node.inputs), ("outputs", node.outputs)):
            for index, port in enumerate(ports):
                unknown = unknown_type(port.type, must_be_here=True, packages=workspaces)
                package = port.type.partition("/")[0]
                if unknown and not _names_package(container.folder, package):
                    pointer = f"{node.pointer}/{side}/{index}/type"
                    place = place_of(node.file, pointer)
                    yield Problem(display_name(node.file), *place, pointer, *unknown)


def _unknown_plugins(loaded: Loaded) -> Iterator[Problem]:
    """Modules that are not installed here, nor named in the folder of the node's container."""
    for node in loaded.project.nodes:
        container = find_container(node.container, loaded.project.folder)
        if node.module and node.plugin == Path() and container and not container.is_own:
            package = node.module.partition(".")[0]
            if not _names_package(container.folder, package):
                pointer = f"{node.pointer}/plugin"
                text, _ = why_no_module(node.module)
                hint = f"nothing in {container.folder} names '{package}'"
                place = place_of(node.file, pointer)
                yield Problem(display_name(node.file), *place, pointer, text, hint)


def _network_problems(node: Node) -> Iterator[Problem]:
    """What is wrong with the network of a node, as far as this Python can read it."""
    if node.module == NETWORK_MODULE and find_spec("h5py"):
        from neuros.snn.nir.network import problems_of

        for text in problems_of(node, Path(node.environment.get(NETWORK, ""))):
            yield _at_network(node, text)


def _network_doubts(loaded: Loaded) -> Iterator[Problem]:
    for node in loaded.project.nodes:
        if node.module == NETWORK_MODULE and not find_spec("h5py"):
            hint = f"h5py is not installed: {install_command('nir')}"
            yield _at_network(node, "the network cannot be checked before the run", hint)
        if node.module == NETWORK_MODULE and "exporter" not in node.parameters:
            text = "is stepped by NIR's own equations, but the library that wrote it may use others"
            hint = 'name that library: "parameters": {"exporter": "snntorch"}, see docs/nir.md'
            yield _at_network(node, text, hint)


def _at_network(node: Node, text: str, hint: str = "") -> Problem:
    pointer = f"{node.pointer}/network"
    return Problem(display_name(node.file), *place_of(node.file, pointer), pointer, text, hint)


def _names_package(folder: Path, package: str) -> bool:
    """Whether a file of a container's folder names a package, as ROS or as Debian and pip do."""
    files = [file for file in folder.iterdir() if file.is_file()]
    short = (file for file in files if file.stat().st_size < _LONG_BYTES)
    return any(package in file.read_text("utf-8", "replace").replace("-", "_") for file in short)


def workspaces_of(project: Path) -> Workspaces:
    """The workspaces that a project, a file or a folder, sees."""
    folder = project if project.is_dir() else project.parent
    return Workspaces(folder.resolve() / "workspace", WORKSPACE, os.environ)
