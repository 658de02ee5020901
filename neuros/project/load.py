"""Loading of a project: read, override, check, build; all problems are reported at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from neuros.errors import Problem, ProjectError
from neuros.project.checks import (
    container_in_place_of,
    copies_of,
    is_for_gazebo,
    mistakes,
    plugin_problems,
    remarks,
    unconnected_ports,
    unread_variables,
)
from neuros.project.in_python import FILE, PythonProject
from neuros.project.message_types import (
    NO_PACKAGES,
    MessagePackages,
    normalised,
    unknown_type,
    with_copies,
    wrong_array,
)
from neuros.project.model import (
    FINALISE_S,
    PLUGIN_KEYS,
    Access,
    Budgets,
    Connection,
    Node,
    Port,
    Project,
    Resources,
    access_of,
    durations_of,
    parameters_of,
    resources_of,
)
from neuros.project.parsed import (
    ParsedProject,
    apply_option,
    apply_override,
    apply_remaps,
    names_of,
    parse_project,
)
from neuros.project.paths import PathError, Roots, find_module, is_module_name, why_no_module
from neuros.project.plugin_files import file_of
from neuros.project.qos import qos_of
from neuros.project.scanner import Element, SourceError, display_name
from neuros.project.suggest import did_you_mean
from neuros.project.timing import REAL
from neuros.project.validate import apply_timing, violations

STANDARD_CONTAINERS = frozenset(
    {
        *("neuros_python", "neuros_mujoco", "neuros_nest", "neuros_tensorflow"),
        *("neuros_nir", "neuros_onnx"),
    }
)
"""NeuROS's own images: they have the message packages that this machine has."""
PROJECT_FILE = "project.json"
_T = TypeVar("_T")
_ELSEWHERE = re.compile(r"[a-z]+:")
"""Begins the name of what a library finds, in the place of a file: ``lerobot:user/name``."""
_OWN_VARIABLES = frozenset(
    f"NEUROS_{name}" for name in ("RUN_ID", "RUN_DIR", "CONTROL", "ELSEWHERE")
)
"""Variables by which the processes of a run, and the guardian, find each other."""


class _Builder:
    """Builds nodes, also of files with problems.

    Attributes:
        problems: missing files and unknown types; the nodes lack them.
    """

    def __init__(self, parsed: ParsedProject) -> None:
        self._roots = parsed.roots
        self._functions = parsed.functions
        self.problems: list[Problem] = []

    def node(self, element: Element) -> Node:
        """The node that an object describes."""
        environment: dict[str, str] = {}
        paths: list[str] = []
        for name, member in element.members("environment").items():
            if is_for_gazebo(name) and not self._roots.finds(member.value, member.source.folder):
                continue
            if name in _OWN_VARIABLES:
                text = f"'{name}' is set by NeuROS itself: remove it"
                self.problems.append(member.key_problem(text))
                continue
            value = member.value
            is_text = isinstance(value, str) and value[:1] in ("#", "@") and "\0" not in value
            if not is_text:
                is_number = isinstance(value, bool | int | float)
                environment[name] = member.text if is_number else str(value)
            elif value[:2] in ("##", "@@"):
                environment[name] = value[1:]
            else:
                advice = f"write '{value[0]}{value}' if it is not a path"
                found = self._find(member, folder_allowed=True, advice=advice)
                environment[name] = str(found or "")
                paths.append(name)
        keys, cores = element.plain, (core.value for core in element.items("affinity"))
        hooks = self._hooks(element)
        module, plugin = ("", file_of(hooks)) if hooks else self._plugin(element)
        for key, own in PLUGIN_KEYS.items():
            if element.member(key) is None:
                continue
            module, plugin = own, find_module(own) or Path()
            if _ELSEWHERE.match(name := element.string(key) or ""):
                environment[key.upper()] = name
            else:
                environment[key.upper()] = str(self._file(element, key) or "")
                paths.append(key.upper())
        return Node(
            name=element.string("name") or "",
            container=container_in_place_of(element.string("container") or ""),
            plugin=plugin,
            script=self._file(element, "script"),
            inputs=self._ports(element, "inputs"),
            outputs=self._ports(element, "outputs"),
            environment=environment,
            file=element.source.file,
            pointer=element.pointer,
            environment_paths=tuple(sorted(paths)),
            affinity=tuple(int(c) for c in cores if isinstance(c, int | float) and c % 1 == 0),
            resources=_if_valid(lambda: resources_of(keys), Resources()),
            access=_if_valid(lambda: access_of(keys), Access()),
            parameters=_if_valid(lambda: parameters_of(keys.get("parameters", {})), {}),
            module=module,
            finalise_s=_if_valid(lambda: float(keys.get("finalise_s", FINALISE_S)), FINALISE_S),
            hooks=hooks,
            copies=copies_of(element),
            durations=_if_valid(lambda: durations_of(keys.get("durations", {})), {}),
        )

    def _hooks(self, element: Element) -> tuple[Callable[..., Any], ...]:
        """The functions of a node in Python, unless ``--set`` has given it another plugin."""
        plugin = element.member("plugin")
        return next((functions for member, functions in self._functions if member is plugin), ())

    def _plugin(self, element: Element) -> tuple[str, Path]:
        """The module of the plugin, empty if a file has that name, and its file."""
        member, name = element.member("plugin"), element.string("plugin") or ""
        if member is None or not is_module_name(name):
            return "", self._file(element, "plugin") or Path()
        try:
            return "", self._roots.find(name, member.source.folder)
        except PathError as error:
            text, hint = why_no_module(name)
            path = find_module(name)
            if path is None and self._is_like_this_machine(element):
                self.problems.append(member.problem(text, error.hint or hint))
        return name, path or Path()

    def _is_like_this_machine(self, node: Element) -> bool:
        """Whether the node's container has the packages of this machine."""
        container = container_in_place_of(node.string("container") or "")
        return container.partition(":")[0] in STANDARD_CONTAINERS

    def _file(self, element: Element, key: str) -> Path | None:
        member = element.member(key)
        if member is None or not isinstance(member.value, str) or not member.value:
            return None
        return self._find(member, folder_allowed=False)

    def _find(self, member: Element, *, folder_allowed: bool, advice: str = "") -> Path | None:
        try:
            return self._roots.find(
                member.value, member.source.folder, folder_allowed=folder_allowed
            )
        except PathError as error:
            self.problems.append(member.problem(error.text, error.hint or advice))
            return None

    def _ports(self, node: Element, side: str) -> tuple[Port, ...]:
        must_be_here, copies = self._is_like_this_machine(node), copies_of(node)
        return tuple(
            self._port(port, copies, is_input=side == "inputs", must_be_here=must_be_here)
            for port in node.items(side)
            if isinstance(port.value, dict)
        )

    def _port(
        self, element: Element, copies: int | None, *, is_input: bool, must_be_here: bool
    ) -> Port:
        written, keys = with_copies(element.string("type") or "", copies), element.plain
        type_name = normalised(written)
        unknown = wrong_array(written) or (
            type_name
            and unknown_type(type_name, must_be_here=must_be_here, packages=self._roots.packages)
        )
        if unknown:
            self.problems.append(element.value["type"].problem(*unknown))
        more = {"mujoco": keys["mujoco"]} if "mujoco" in keys else {}
        if "qos" in keys:
            more["qos"] = _if_valid(lambda: qos_of(keys["qos"], is_input=is_input), None)
        return Port(
            name=element.string("name") or "",
            type=type_name or written,
            external_topic=element.string("external_topic"),
            gazebo_type=element.string("gazebo_type"),
            **more,
        )


def _if_valid(read: Callable[[], _T], default: _T) -> _T:
    """The result of ``read``; ``default`` for an invalid value, which the schema reports."""
    try:
        return read()
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, OverflowError):
        return default


@dataclass(frozen=True)
class LoadedProject:
    """A valid project, and warnings of possible mistakes in it.

    Attributes:
        unconnected: those of the warnings that name a port without a connection; a session may read
            such an output, and send to such an input.
    """

    project: Project
    warnings: tuple[Problem, ...] = ()
    unconnected: frozenset[Problem] = frozenset()


def load_project(
    path: Path | PythonProject,
    *,
    workspace: Path,
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    packages: MessagePackages = NO_PACKAGES,
    namespace: str | None = None,
    remap: Sequence[str] = (),
    time: str | None = None,
    timing: Path | None = None,
    reads_plugins: bool = False,
) -> LoadedProject:
    """Load and check a project.

    Args:
        path: the project file, a folder that holds ``project.json``, or a project in Python.
        workspace: the second folder of ``@path``, after the project's own workspace.
        overrides: the texts of ``--set``, applied in this order.
        folder: the project's folder, if not that of the file: the expanded project of a run is in
            the folder of the run.
        packages: message packages of workspaces.
        namespace: the text of ``--namespace``; it replaces the project's own.
        remap: the texts of ``--remap``; they come before the project's own rules.
        time: the clock that replaces the project's own, ``real`` or ``virtual``.
        timing: a file with durations and delays, which replace those of the project.
        reads_plugins: whether to check the sources of plugins, too.

    Raises:
        ProjectError: with all problems.
    """
    if isinstance(path, PythonProject):
        file = path.folder / FILE
    else:
        file = path.resolve() / PROJECT_FILE if path.is_dir() else path.parent.resolve() / path.name
        if problem := _no_project_at(path, file):
            raise ProjectError([problem])
    roots = Roots((folder or file.parent).resolve(), workspace.resolve(), packages)
    try:
        parsed = (
            path.parsed(roots) if isinstance(path, PythonProject) else parse_project(file, roots)
        )
    except SourceError as error:
        raise ProjectError([error.problem]) from None
    for text in overrides:
        parsed.problems += apply_override(parsed, text)
    apply_option(parsed, "namespace", namespace)
    apply_option(parsed, "time", time)
    parsed.problems += apply_remaps(parsed, remap)
    if timing is not None:
        parsed.problems += apply_timing(parsed, timing)
    builder = _Builder(parsed)
    names = names_of(parsed)
    nodes = tuple(builder.node(element) for element in parsed.nodes)
    problems = [*parsed.problems, *violations(parsed), *mistakes(parsed), *builder.problems]
    connections: tuple[Connection, ...] = ()
    if not problems:
        connections = tuple(
            Connection.of(element.plain, index=index, namespace=names.namespace)
            for index, element in enumerate(parsed.connections)
        )
    doubts: list[Problem] = []
    if reads_plugins:
        misfits, doubts = plugin_problems(parsed, nodes, None if problems else connections)
        problems += misfits
    if problems:
        raise ProjectError(problems)
    if reads_plugins:
        doubts += unread_variables(parsed, nodes, overrides)
    keys = parsed.root.plain
    budgets: dict[str, Any] = keys.get("budgets", {})
    lost = {name: int(most) for name, most in budgets.get("lost_packets", {}).items()}
    project = Project(
        name=_name(roots.project, file),
        nodes=nodes,
        connections=connections,
        file=roots.project / file.name,
        description=keys.get("description", ""),
        budgets=Budgets(**{**budgets, "lost_packets": lost}),
        names=names,
        dashboard=keys.get("dashboard"),
        is_portable=keys.get("portable", False),
        time=keys.get("time", REAL),
    )
    loose = [*unconnected_ports(parsed)]
    told = (*sorted([*remarks(parsed), *loose]), *doubts)
    return LoadedProject(project, told, frozenset(loose))


def _no_project_at(path: Path, file: Path) -> Problem | None:
    """Why ``file`` cannot be the project file of the path that the user gave."""
    name = display_name(file)
    if path.is_dir() and not file.is_file():
        others = sorted(other.name for other in path.glob("*.json"))
        hint = f"it has {', '.join(others)}" if others else ""
        return Problem(name, 0, 0, "", f"the folder '{path}' has no {PROJECT_FILE}", hint)
    if not file.exists():
        names = (entry.name for entry in file.parent.glob("*"))
        hint = did_you_mean(file.name, names) or f"the current folder is {Path.cwd()}"
        return Problem(name, 0, 0, "", "there is no such file", hint)
    if file.suffix == ".py":
        hint = f"name its {PROJECT_FILE}, or their folder"
        return Problem(name, 1, 1, "/", "is a plugin, not a project", hint)
    return None


def _name(folder: Path, file: Path) -> str:
    """The project's name: that of the folder, with that of the file if it is a variant."""
    name = folder.name or "project"
    return name if file.name in (PROJECT_FILE, FILE) else f"{name}-{file.stem}"
