"""Loading of a project, together with the message packages that it sees."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

from neuros.api.plan import make_environments
from neuros.backends.containers import BASE, OWN_FOLDER, find_container, why_no_container
from neuros.backends.node_command import signal_in_words, without_mark
from neuros.backends.pythons import Pythons
from neuros.distribution import WORKSPACE, python_command
from neuros.errors import EnvironmentFault, Problem, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.project.load import Loaded, load_project
from neuros.project.loops import Loops, modules_beside
from neuros.project.message_types import unknown_type
from neuros.project.model import NETWORK_MODULE, Node, Project
from neuros.project.paths import is_missing, modules_here, why_no_module
from neuros.project.plugin_files import PluginFile, read_plugin
from neuros.project.scanner import display_name, problem_in
from neuros.project.suggest import did_you_mean
from neuros.recording.provenance import seeds
from neuros.registry import NAMES, PLUGIN_CHECKS

_LONG_BYTES = 1 << 20
"""A file of a container's folder from this size on is data, not a recipe."""
_CLOSE = 0.8  # difflib's similarity of besides and beside
_MJCF = (".xml", ".mjcf")
_MODELS = (*_MJCF, ".urdf", ".sdf", ".world")
_PLACE = re.compile(r"(\S.*?):(\d+):(\d+): (.*)")
_LINE = re.compile(r"\bline (?:number=)?(\d+)", re.IGNORECASE)


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
    nodes = [node for node in loaded.project.nodes if node.module]
    checks = [(n, PLUGIN_CHECKS.load(n.module)) for n in nodes if n.module in PLUGIN_CHECKS]
    if reads_plugins:
        for node in nodes:
            if text := PLUGIN_CHECKS.missing(node.module):
                key = "network" if node.module == NETWORK_MODULE else "plugin"
                problems.append(problem_in(node.file, f"{node.pointer}/{key}", text))
        problems += [problem for node, check in checks for problem in check.problems(node)]
        if problems:
            raise ProjectError(problems)
    doubts = (
        *_unknown_types(loaded, workspaces),
        *_unknown_plugins(loaded),
        *(doubt for node, check in checks for doubt in check.doubts(node)),
        *(foreseen_failures(loaded.project, messages, looks_beside=False) if reads_plugins else ()),
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


def _unknown_containers(project: Project) -> Iterator[Problem]:
    """The containers that are probably meant to be others."""
    for node in project.nodes:
        text, hint = why_no_container(node.container, project.folder)
        if text:
            yield problem_in(node.file, f"{node.pointer}/container", text, hint)


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
                    yield problem_in(node.file, f"{node.pointer}/{side}/{index}/type", *unknown)


def _unknown_plugins(loaded: Loaded) -> Iterator[Problem]:
    """Modules that are not installed here, nor named in the folder of the node's container."""
    for node in loaded.project.nodes:
        container = find_container(node.container, loaded.project.folder)
        if node.module and node.plugin == Path() and container and not container.is_own:
            package = node.module.partition(".")[0]
            if not _names_package(container.folder, package):
                text, _ = why_no_module(node.module)
                hint = f"nothing in {container.folder} names '{package}'"
                yield problem_in(node.file, f"{node.pointer}/plugin", text, hint)


def _names_package(folder: Path, package: str) -> bool:
    """Whether a file of a container's folder names a package, as ROS or as Debian and pip do."""
    files = [file for file in folder.iterdir() if file.is_file()]
    short = (file for file in files if file.stat().st_size < _LONG_BYTES)
    return any(package in file.read_text("utf-8", "replace").replace("-", "_") for file in short)


def workspaces_of(project: Path) -> Workspaces:
    """The workspaces that a project, a file or a folder, sees."""
    folder = project if project.is_dir() else project.parent
    return Workspaces(folder.resolve() / "workspace", WORKSPACE, os.environ)


# ---------------------------------------------------------------------- what would fail


def foreseen_failures(
    project: Project, messages: Messages, *, looks_beside: bool = True
) -> list[Problem]:
    """What does not keep a run from starting, but from going well: it will fail, or do nothing.

    ``validate`` refuses it. Before a run these are warnings, since what is in an image is not
    known here.

    Args:
        looks_beside: also at what the modules beside a plugin import, which takes a while.
    """
    return [
        *_unknown_containers(project),
        *Loops(project).problems(),
        *_missing_modules(project, messages, looks_beside),
    ]


def _missing_modules(project: Project, messages: Messages, looks_beside: bool) -> list[Problem]:
    """What plugins import, and the Python that they run on lacks."""
    lacking = {
        node.name: found
        for node in project.nodes
        if node.script is None and (found := [*_lacking(node, project, messages, looks_beside)])
    }
    if not lacking:
        return []
    try:
        elsewhere = Pythons.choose(project.nodes, project.folder, os.environ).paths
    except EnvironmentFault:  # a run says what is wrong with a container
        return []
    return [each for name, of in lacking.items() if name not in elsewhere for each in of]


def _lacking(
    node: Node, project: Project, messages: Messages, looks_beside: bool
) -> Iterator[Problem]:
    path = node.environment.get("PYTHONPATH", "").split(os.pathsep)
    folders = [str(node.plugin.parent), *filter(None, path), *map(str, messages.paths)]
    built = {each.package for each in messages.built}
    container = find_container(node.container, project.folder)
    for part in islice(_parts(node.plugin), None if looks_beside else 1):
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
                missing = NAMES.missing(needed.name.removeprefix("neuros."))
                hint = missing or _place_of_module(top, node)
            if text:
                place = needed.line, needed.column
                yield Problem(display_name(part.path), *place, "", text, hint)


def _place_of_module(name: str, node: Node) -> str:
    """A hint for a module that is not there."""
    beside = {file.stem for file in node.plugin.parent.glob("*.py")}
    if close := get_close_matches(name, {*beside, *modules_here()} - {name}, 1, _CLOSE):
        return f"did you mean '{close[0]}'?"
    return (
        f"packages such as {name} go into the requirements.txt of the node's container, modules of"
        " your own beside the plugin: docs/environments.md"
    )


# ---------------------------------------------------------------------- slow checks
#
# Slow checks of a project: its MuJoCo models, and imports of its plugins.
#
# A run finds these out by itself, a moment later.


def model_problems(project: Project) -> list[Problem]:
    """What is wrong with MuJoCo models, and with sensors and actuators that are declared for them.

    A model is known where the plugin names it by a literal or an environment variable of its node,
    and MuJoCo is installed here.
    """
    nodes = [node for node in project.nodes if _has_model(node)]
    if not nodes or find_spec("mujoco") is None:
        return []
    return [problem for node in nodes for problem in _model_problems(node, project.folder)]


def import_problems(
    project: Project, messages: Messages, path: Path, overrides: Sequence[str]
) -> list[Problem]:
    """Import each plugin as its node would in a process of its own; what fails, by node.

    Args:
        path: the project as it was named; it is loaded once more for each node.

    Raises:
        EnvironmentFault: if the Python of a node cannot be made.
    """
    pythons = Pythons.choose(project.nodes, project.folder, os.environ)
    make_environments(pythons, messages, sys.stderr)
    problems = []
    for node in project.nodes:
        python = pythons.paths.get(node.name, Path(sys.executable))
        said = _import(python, node.name, path, overrides)
        if said:
            problems.append(Problem(f"node '{node.name}'", 0, 0, "", said))
    return problems


def _import(python: Path, name: str, path: Path, overrides: Sequence[str]) -> str:
    """What is wrong with the plugin of a node; what it prints goes to standard error."""
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
                said = answer.read()
    code = child.returncode
    how = signal_in_words(-code) if code < 0 else f"exit code {code}"
    return said or (f"importing the plugin ended its process: {how}" if code else "")


# ---------------------------------------------------------------------- models


def _has_model(node: Node) -> bool:
    parts = _parts(node.plugin)
    return any(port.mujoco for port in (*node.inputs, *node.outputs)) or any(
        part.model_arguments for part in parts
    )


def _model_problems(node: Node, project: Path) -> Iterator[Problem]:
    parts = [*_parts(node.plugin)]
    models = [(part, argument) for part in parts for argument in part.model_arguments]
    if len(models) != 1:
        return
    (part, argument), sets_timestep = models[0], any(part.sets_timestep for part in parts)
    model = _model(argument, node, project)
    if isinstance(model, tuple):
        place = display_name(part.path), argument.lineno, argument.col_offset + 1
        yield Problem(*place, "", *model)
    if model is None or isinstance(model, tuple):
        return
    from neuros.simulators.mujoco.world import problems_of

    for pointer, text in problems_of(node, model):
        if pointer and not (sets_timestep and pointer.endswith("/rate")):
            yield problem_in(node.file, pointer, text)
        elif not pointer:
            yield from _located_in(model if isinstance(model, Path) else node.plugin, text)


def _located_in(file: Path, text: str) -> Iterator[Problem]:
    """What a compiler of models says, in one line or several, with the place where it names one."""
    for row in text.splitlines():
        if found := _PLACE.fullmatch(row):
            yield Problem(found[1], int(found[2]), int(found[3]), "", found[4])
            continue
        line = _LINE.search(row)
        said = row.removeprefix(f"{file}: ")
        yield Problem(display_name(file), *((int(line[1]), 1) if line else (0, 0)), "", said)


def _parts(plugin: Path) -> Iterator[PluginFile]:
    """A plugin, and the modules beside it that it imports."""
    read = read_plugin(plugin) if plugin != Path() else None
    if read is not None:
        yield read
        yield from modules_beside(read)


def _model(argument: ast.expr, node: Node, project: Path) -> Path | str | tuple[str, str] | None:
    """A file with a model, or MJCF as text; a problem and its hint where that is not there.

    ``None`` where it is not known.
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
    """The text that an expression of a plugin stands for."""
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
