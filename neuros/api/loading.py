"""Loading of a project, together with the message packages that it sees."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

from neuros.api.plan import make_environments
from neuros.backends.containers import BASE, OWN_FOLDER, find_container, why_no_container
from neuros.backends.node_command import signal_in_words, without_mark
from neuros.backends.pythons import Pythons
from neuros.distribution import WORKSPACE, python_command
from neuros.errors import EnvironmentFault, Problem, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.project.in_python import PythonProject
from neuros.project.load import LoadedProject, load_project
from neuros.project.loops import Loops, modules_beside
from neuros.project.message_types import unknown_type
from neuros.project.model import MODEL_FIELDS, Node, Project
from neuros.project.paths import is_missing, modules_here, why_no_module
from neuros.project.plugin_files import PluginFile, plugins_of
from neuros.project.scanner import display_name, problem_in
from neuros.project.suggest import did_you_mean
from neuros.project.timing import seeds
from neuros.registry import NAMES, PLUGIN_CHECKS

_LONG_BYTES = 1 << 20
"""Larger files in the folder of a container are data, not a recipe."""
_CLOSE = 0.8  # similarity in difflib's scale, as of besides and beside
_MJCF = (".xml", ".mjcf")
_MODELS = (*_MJCF, ".urdf", ".xacro", ".sdf", ".world")
_PLACE = re.compile(r"(\S.*?):(\d+):(\d+): (.*)")
_LINE = re.compile(r"\bline (?:number=)?(\d+)", re.IGNORECASE)


def load_with_messages(
    path: Path | PythonProject,
    overrides: Sequence[str] = (),
    namespace: str | None = None,
    remap: Sequence[str] = (),
    time: str | None = None,
    timing: str | os.PathLike[str] | None = None,
    *,
    reads_plugins: bool = True,
) -> tuple[LoadedProject, Messages]:
    """Load a project and find its message packages.

    Args:
        reads_plugins: whether to read the source of plugins, too.

    Raises:
        ProjectError: with all problems of the project and of its message files.
    """
    workspaces = workspaces_of(path if isinstance(path, Path) else path.folder)
    try:
        loaded = load_project(
            path,
            workspace=WORKSPACE,
            overrides=overrides,
            packages=workspaces,
            namespace=namespace,
            remap=remap,
            time=time,
            timing=None if timing is None else Path(timing),
            reads_plugins=reads_plugins,
        )
    except ProjectError as error:
        problems = Messages(workspaces, workspaces.own).problems()
        raise ProjectError([*error.problems, *problems]) from None
    messages = Messages.of_nodes(loaded.project.nodes, workspaces)
    if problems := messages.problems():
        raise ProjectError(problems)
    nodes = [node for node in loaded.project.nodes if node.module]
    checks = [(n, PLUGIN_CHECKS.load(n.module)) for n in nodes if n.module in PLUGIN_CHECKS]
    if reads_plugins:
        for node in nodes:
            if text := PLUGIN_CHECKS.missing(node.module):
                problems.append(problem_in(node.file, f"{node.pointer}/{node.plugin_key}", text))
        problems += [problem for node, check in checks for problem in check.problems(node)]
        if problems:
            raise ProjectError(problems)
    doubts = (
        *messages.doubts(),
        *_unknown_in_containers(loaded.project, workspaces),
        *(doubt for node, check in checks for doubt in check.doubts(node)),
        *(foreseen_failures(loaded.project, messages, looks_beside=False) if reads_plugins else ()),
    )
    return replace(loaded, warnings=(*loaded.warnings, *doubts)), messages


def override_texts(settings: Mapping[str, Any] | Sequence[str] | None) -> tuple[str, ...]:
    """Settings as texts of ``--set``: ``["nodes.a.environment.RATE=0.5"]``."""
    if not isinstance(settings, Mapping):
        return tuple(settings or ())
    return tuple(f"{path}={value_text(path, value)}" for path, value in settings.items())


def value_text(path: str, value: Any) -> str:
    """A value as text for ``--set``; ``None``, which removes the key, is empty.

    Raises:
        UsageError: if JSON has no such value.
    """
    if value is None:
        return ""
    if isinstance(value, str) and path.split(".")[2:3] == ["environment"]:
        return value
    try:
        return json.dumps(value.tolist() if hasattr(value, "tolist") else value)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{path}: {error}") from error


def seed_variables(project: Project, seed: int) -> dict[str, dict[str, str]]:
    """By node, the variables with SEED in their names in its environment, set to this seed.

    Raises:
        UsageError: if no node has such a variable.
    """
    found = seeds(project.nodes)
    if not found:
        raise UsageError(
            f"seed {seed}: no node of {project.name} has an environment variable with SEED in its"
            " name: add the one that its plugin reads to its environment"
        )
    return {name: dict.fromkeys(variables, str(int(seed))) for name, variables in found.items()}


def with_model_fields(project: Project, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings for ``--set`` of settings that may name fields of a simulated model.

    Those are ``robot.model.geom_friction``; they reach the node by a variable of its environment.

    Raises:
        UsageError: if there is no such node.
    """
    found: dict[str, Any] = {}
    fields: dict[str, dict[str, Any]] = {}
    nodes = {node.name: node for node in project.nodes}
    for path, value in settings.items():
        node, _, rest = path.partition(".")
        kind, _, name = rest.partition(".")
        if node == "nodes" or kind != "model" or not name:
            found[path] = value
        elif node in nodes:
            before = nodes[node].environment.get(MODEL_FIELDS, "{}")  # of the session, perhaps
            value = value.tolist() if hasattr(value, "tolist") else value
            fields.setdefault(node, json.loads(before))[name] = value
        else:
            hint = did_you_mean(node, nodes) or f"it has {', '.join(nodes)}"
            raise UsageError(f"'{path}': {project.name} has no node '{node}' ({hint})")
    for node, values in fields.items():
        try:
            text = json.dumps(values, allow_nan=False)
        except (TypeError, ValueError) as error:
            names = ", ".join(f"{node}.model.{name}" for name in values)
            raise UsageError(f"{names}: give finite numbers, or arrays of them: {error}") from None
        found[f"nodes.{node}.environment.{MODEL_FIELDS}"] = text
    return found


def _unknown_in_containers(project: Project, workspaces: Workspaces) -> Iterator[Problem]:
    """Message types and plugins that are neither here nor named in the folder of a container."""
    for node in project.nodes:
        container = find_container(node.container, project.folder)
        if container is None or container.is_own:  # a mistake, or an image of the user
            continue
        for side, ports in (("inputs", node.inputs), ("outputs", node.outputs)):
            for index, port in enumerate(ports):
                unknown = unknown_type(port.type, must_be_here=True, packages=workspaces)
                package = port.ros_type.partition("/")[0]
                if unknown and not _names_package(container.folder, package):
                    yield problem_in(node.file, f"{node.pointer}/{side}/{index}/type", *unknown)
        package = node.module.partition(".")[0]
        is_elsewhere = node.module and node.plugin == Path()
        if is_elsewhere and not _names_package(container.folder, package):
            text, _ = why_no_module(node.module)
            hint = f"nothing in {container.folder} names '{package}'"
            yield problem_in(node.file, f"{node.pointer}/plugin", text, hint)


def _names_package(folder: Path, package: str) -> bool:
    """Whether a file in the folder of a container names a package, with ``_`` or ``-``."""
    files = [file for file in folder.iterdir() if file.is_file()]
    short = (file for file in files if file.stat().st_size < _LONG_BYTES)
    return any(package in file.read_text("utf-8", "replace").replace("-", "_") for file in short)


def workspaces_of(project: Path) -> Workspaces:
    """The workspaces that a project (its file or folder) uses."""
    folder = project if project.is_dir() else project.parent
    return Workspaces(folder.resolve() / "workspace", WORKSPACE, os.environ)


def foreseen_failures(
    project: Project, messages: Messages, *, looks_beside: bool = True
) -> list[Problem]:
    """Problems that let a run start, and then fail or do nothing.

    These are unknown containers, loops, and modules that the Python of a plugin lacks. ``validate``
    refuses them; before a run they are warnings, since the content of an image is not known here.

    Args:
        looks_beside: whether to read the imports of modules beside plugins, too, which takes long.
    """
    problems = []
    for node in project.nodes:
        text, hint = why_no_container(node.container, project.folder)
        if text:
            problems.append(problem_in(node.file, f"{node.pointer}/container", text, hint))
    problems += Loops(project).problems()
    lacking = {
        node.name: found
        for node in project.nodes
        if node.script is None and (found := [*_lacking(node, project, messages, looks_beside)])
    }
    if lacking:
        with suppress(EnvironmentFault):  # a run tells what is wrong with a container
            elsewhere = Pythons.choose(project.nodes, project.folder, os.environ).paths
            problems += [p for name, of in lacking.items() if name not in elsewhere for p in of]
    return problems


def _lacking(
    node: Node, project: Project, messages: Messages, looks_beside: bool
) -> Iterator[Problem]:
    """Modules that a plugin imports, and that its Python on this machine does not have."""
    path = node.environment.get("PYTHONPATH", "").split(os.pathsep)
    folders = [str(node.plugin.parent), *filter(None, path), *map(str, messages.paths)]
    built = {each.package for each in messages.built}
    container = find_container(node.container, project.folder)
    for part in islice(_parts(node), None if looks_beside else 1):
        for needed in part.needs:
            top = needed.name.partition(".")[0]
            text = ""
            if not top and not node.module:
                text = f"'{needed.name}' is relative, but a plugin is in no package"
                hint = f"write '{needed.name.lstrip('.') or 'the name of the module'}' without dots"
            elif top and top not in built and is_missing(needed.name, folders):
                recipes = [container.folder, OWN_FOLDER / BASE] if container else []
                is_named = any(_names_package(recipe, top) for recipe in recipes)
                if is_named and is_missing(top, folders):
                    continue
                text = f"there is no module '{needed.name}'"
                known = {*modules_here(), *(f.stem for f in node.plugin.parent.glob("*.py"))}
                close = get_close_matches(top, known - {top}, 1, _CLOSE)
                hint = NAMES.missing(needed.name.removeprefix("neuros.")) or (
                    f"did you mean '{close[0]}'?"
                    if close
                    else f"packages such as {top} go into the requirements.txt of the node's"
                    " container, modules of your own beside the plugin:"
                    " docs/containers.md#environments-without-docker"
                )
            if text:
                place = needed.line, needed.column
                yield Problem(display_name(part.path), *place, "", text, hint)


# Slow checks follow: MuJoCo models, and imports of plugins. Each run makes them when it starts.


def model_problems(project: Project) -> list[Problem]:
    """Problems of MuJoCo models, and of the sensors and actuators that ports declare for them.

    A model is known if the plugin names it by a literal or an environment variable of its node.
    Without MuJoCo, nothing is checked.
    """
    problems: list[Problem] = []
    for node in project.nodes:
        parts = [*_parts(node)]
        models = [(part, argument) for part in parts for argument in part.model_arguments]
        if len(models) == 1 and find_spec("mujoco") is not None:
            (part, argument), sets_timestep = models[0], any(p.sets_timestep for p in parts)
            model = _model(argument, node, project.folder)
            if isinstance(model, tuple):
                place = display_name(part.path), argument.lineno, argument.col_offset + 1
                problems.append(Problem(*place, "", *model))
            elif model is not None:
                problems += _problems_of_model(node, model, sets_timestep=sets_timestep)
    return problems


def import_problems(
    project: Project, messages: Messages, path: Path, overrides: Sequence[str]
) -> list[Problem]:
    """Import each plugin as its node does in a process of its own; returns what fails.

    Args:
        path: the project as the user named it; the process of each node loads it again.

    Raises:
        EnvironmentFault: if the Python of a node cannot be made.
    """
    pythons = Pythons.choose(project.nodes, project.folder, os.environ)
    make_environments(pythons, messages, sys.stderr)
    problems = []
    for node in project.nodes:
        python = pythons.paths.get(node.name, Path(sys.executable))
        if text := _import(python, node.name, path, overrides):
            problems.append(Problem(f"node '{node.name}'", 0, 0, "", text))
    return problems


def _import(python: Path, name: str, path: Path, overrides: Sequence[str]) -> str:
    """Import the plugin of a node; returns the error. Its output goes to standard error."""
    settings = [part for text in overrides for part in ("--set", text)]
    reading, writing = os.pipe()
    command = python_command(
        "neuros.cli", "import-plugin", name, str(path), *settings, python=python
    )
    command += ["--answer", str(writing)]
    with tempfile.TemporaryDirectory(prefix="neuros-") as folder:
        environment = {**without_mark(os.environ), "TMPDIR": folder}
        with subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr.fileno(),
            pass_fds=[writing],
        ) as child:
            os.close(writing)
            with os.fdopen(reading, encoding="utf-8") as answer:
                text = answer.read()
    code = child.returncode
    how = signal_in_words(-code) if code < 0 else f"exit code {code}"
    return text or (f"importing the plugin ended its process: {how}" if code else "")


def _problems_of_model(node: Node, model: Path | str, *, sets_timestep: bool) -> Iterator[Problem]:
    from neuros.simulators.mujoco.world import problems_of

    file = model if isinstance(model, Path) else node.plugin
    for pointer, text in problems_of(node, model):
        if pointer:
            if not (sets_timestep and pointer.endswith("/rate")):
                yield problem_in(node.file, pointer, text)
            continue
        for row in text.splitlines():  # of a compiler of models, some with their place
            if found := _PLACE.fullmatch(row):
                yield Problem(found[1], int(found[2]), int(found[3]), "", found[4])
                continue
            line = _LINE.search(row)
            place = (int(line[1]), 1) if line else (0, 0)
            yield Problem(display_name(file), *place, "", row.removeprefix(f"{file}: "))


def _parts(node: Node) -> Iterator[PluginFile]:
    """The plugin of a node, and the modules beside it that it imports; nothing of functions."""
    for read in plugins_of(node) if not node.hooks else ():
        yield read
        yield from modules_beside(read)


def _model(argument: ast.expr, node: Node, project: Path) -> Path | str | tuple[str, str] | None:
    """The file of a model, or MJCF as text; a problem and its hint if there is no such file.

    ``None`` if the model is not known.
    """
    text = _text(argument, node)
    if text is None or text.lstrip().startswith("<"):
        return text
    places = dict.fromkeys((node.plugin.parent, node.file.parent, project))
    files = [place / text.removeprefix("#").lstrip("/") for place in places]
    files = [Path(text)] if Path(text).is_absolute() else files
    found = next((f for f in files if f.suffix in _MODELS and f.is_file()), None)
    if found is None and Path(text).suffix in _MJCF and not text.startswith("@"):
        beside = [f.name for file in files for f in file.parent.glob("*") if f.suffix in _MODELS]
        return f"there is no model '{text}'", did_you_mean(Path(text).name, beside)
    return found


def _text(expression: ast.expr, node: Node) -> str | None:
    """The value of an expression in a plugin, ``None`` if it is not known."""
    match expression:
        case ast.Constant(value=str(text)):
            return text
        case ast.Subscript(value=ast.Attribute(attr="environ"), slice=ast.Constant(value=str(key))):
            return node.environment.get(key)
        case ast.Call(
            func=ast.Attribute(attr="get" | "getenv"), args=[ast.Constant(value=str(key)), *_]
        ):
            return node.environment.get(key)
        case ast.Call(func=ast.Attribute(attr="resolve_path"), args=[argument]):
            return _text(argument, node)
        case ast.Call(func=ast.Name(id="str" | "Path"), args=[argument]):
            return _text(argument, node)
    return None
