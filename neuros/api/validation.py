"""Slow checks of a project: timesteps of its MuJoCo models, and imports of its plugins.

A run finds these out by itself, a moment later.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from neuros.api.plan import make_environments
from neuros.backends.node_command import signal_in_words, without_mark
from neuros.backends.pythons import Pythons
from neuros.errors import Problem
from neuros.messages.needed import Messages
from neuros.project.model import Node, Project
from neuros.project.plugin_files import PluginFile, read_plugin
from neuros.project.scanner import display_name, place_of


def model_problems(project: Project) -> list[Problem]:
    """Sensors whose rates do not fit the timestep of their MuJoCo model, where that is known.

    It is known where the plugin names one model in MJCF, by a literal or an environment variable of
    its node, and MuJoCo is installed here.
    """
    nodes = [node for node in project.nodes if _rates(node)]
    if not nodes or find_spec("mujoco") is None:
        return []
    return [problem for node in nodes for problem in _rate_problems(node, project.folder)]


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
    command = [str(python), "-m", "neuros.cli", "import-plugin", name, str(path), *settings]
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


def _rates(node: Node) -> dict[int, float]:
    """The rates of sensors, in Hz, by the place of their output."""
    rates = {index: port.mujoco.get("rate") for index, port in enumerate(node.outputs)}
    return {index: float(rate) for index, rate in rates.items() if rate}


def _rate_problems(node: Node, project: Path) -> Iterator[Problem]:
    parts = [*_parts(node.plugin)]
    models = [argument for part in parts for argument in part.model_arguments]
    if len(models) != 1 or any(part.sets_timestep for part in parts):
        return
    model = _model(models[0], node, project)
    if model is None:
        return
    from neuros.simulators.mujoco.timing import Timebase
    from neuros.simulators.mujoco.world import timestep_of

    try:
        time = Timebase(timestep_of(model))
    except ValueError as error:
        where = display_name(model if isinstance(model, Path) else node.plugin)
        yield Problem(where, 0, 0, "", " ".join(str(error).split()))
        return
    for index, rate in _rates(node).items():
        try:
            time.period_steps(rate)
        except ValueError as error:
            pointer = f"{node.pointer}/outputs/{index}/mujoco/rate"
            yield Problem(
                display_name(node.file), *place_of(node.file, pointer), pointer, str(error)
            )


def _parts(plugin: Path) -> Iterator[PluginFile]:
    """A plugin, and the modules beside it that it imports."""
    read = read_plugin(plugin)
    if read is not None:
        yield read
        modules = (read_plugin(plugin.parent / f"{name}.py") for name in sorted(read.imports))
        yield from (module for module in modules if module is not None)


def _model(argument: ast.expr, node: Node, project: Path) -> Path | str | None:
    """A file in MJCF, or its text; ``None`` where that is not known."""
    text = _text(argument, node)
    if text is None or text.lstrip().startswith("<"):
        return text
    places = (node.plugin.parent, node.file.parent, project)
    files = [place / text.removeprefix("#").lstrip("/") for place in places]
    files = [Path(text)] if Path(text).is_absolute() else files
    return next((f for f in files if f.suffix == ".xml" and f.is_file()), None)


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
