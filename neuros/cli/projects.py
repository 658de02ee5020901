"""``neuros new`` and ``example``, ``validate``, ``graph`` and ``types``: projects, and no runs."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from neuros.cli.common import (
    JSON,
    add_format,
    add_project,
    load_quietly,
    load_with_messages,
    print_json,
    project_path,
    show_warnings,
)
from neuros.distribution import EXAMPLES, PACKAGE
from neuros.errors import NeurosError, ProjectError, UsageError
from neuros.ports import RobotChoices
from neuros.project.suggest import counted, did_you_mean
from neuros.registry import BAG_FORMATS, MODELS

EXIT_NODE = 1
EXIT_PROJECT = 3
_GRAPH_SUFFIXES = {".svg": "svg", ".mmd": "mermaid", ".mermaid": "mermaid"}


def add_validate(validate: argparse.ArgumentParser) -> None:
    validate.description = (
        "Check a project and list every problem with its file, line and column. Plugins are read,"
        " but not run."
    )
    add_project(validate)
    validate.add_argument(
        "--import",
        dest="imports",
        action="store_true",
        help="also import the plugin of each node, as its process would: code outside of functions"
        " runs, hooks do not",
    )
    add_format(validate)
    validate.set_defaults(command=_validate)


def _validate(parsed: argparse.Namespace) -> int:
    from neuros.api.loading import foreseen_failures, import_problems, model_problems
    from neuros.project.loops import Loops

    is_json = parsed.format == JSON
    try:
        project, messages, warnings = load_quietly(parsed)
        problems = [*model_problems(project), *foreseen_failures(project, messages)]
        show_warnings(each for each in warnings if each not in problems)
        if not problems and parsed.imports:
            problems = import_problems(project, messages, project_path(parsed), parsed.set)
        if problems:
            raise ProjectError(problems)
    except ProjectError as error:
        if not is_json:
            raise
        print_json({"is_valid": False, "problems": error.problems})
        return EXIT_PROJECT
    loops = Loops(project).found
    if is_json:
        print_json({"is_valid": True, "problems": [], "loops": loops})
        return 0
    print(
        f"{project.file}: valid: {counted(len(project.nodes), 'node')},"
        f" {counted(len(project.connections), 'connection')}"
    )
    for loop in loops:
        print(loop)
    return 0


def add_import_plugin(command: argparse.ArgumentParser) -> None:
    command.add_argument("name")
    command.add_argument("project")
    command.add_argument("--set", action="append", default=[])
    command.add_argument("--answer", type=int, required=True)
    command.set_defaults(command=_import_plugin)


def _import_plugin(options: argparse.Namespace) -> int:
    """Import the plugin of one node as a run would; the answer is its error, or empty."""
    from neuros.testing import PluginHarness

    with os.fdopen(options.answer, "w", encoding="utf-8", errors="backslashreplace") as answer:
        try:
            PluginHarness.from_project(options.project, options.name, overrides=options.set)
        except NeurosError as error:
            answer.write(str(error))
            return EXIT_NODE
    return 0


def add_graph(graph: argparse.ArgumentParser) -> None:
    graph.description = "Show the nodes and connections of a project without running it."
    add_project(graph)
    graph.add_argument(
        "--format",
        choices=("text", "mermaid", "svg"),
        help="for the terminal, a Mermaid diagram for Markdown, or a picture (default: text, unless"
        " the name of the file ends in .mmd or .svg)",
    )
    graph.add_argument(
        "-o", "--output", metavar="FILE", help="write to this file, not to the terminal"
    )
    graph.set_defaults(command=_graph)


def add_types(types: argparse.ArgumentParser) -> None:
    types.description = (
        "Write stubs of the message classes that a project uses, so that editors complete the"
        " fields of packets, and mypy and Pyright check them."
    )
    add_project(types)
    types.add_argument(
        "-o",
        "--output",
        metavar="FOLDER",
        help="the folder for the stubs (default: typings, where Pyright and VS Code look)",
    )
    types.set_defaults(command=_types)


def _types(options: argparse.Namespace) -> int:
    """Write the stubs. Raises ``UsageError`` if they cannot be written."""
    from neuros.cli.environments import build_messages
    from neuros.messages.stubs import write_stubs

    project, messages = load_with_messages(options, reads_plugins=False)
    if code := build_messages(messages):
        return code
    sys.path[:0] = map(str, messages.paths)
    ports = [port for node in project.nodes for port in (*node.inputs, *node.outputs)]
    folder = Path(options.output or "typings")
    try:
        files = write_stubs({port.ros_type for port in ports}, folder)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror})") from error
    print(f"{folder}: {counted(len(files), 'package')} of messages")
    return 0


def _graph(options: argparse.Namespace) -> int:
    """Write the graph of a project. Raises ``UsageError`` if the file cannot be written."""
    from neuros.project.graph import graph_mermaid, graph_text

    makers = {"text": graph_text, "mermaid": graph_mermaid}
    kind = options.format or _GRAPH_SUFFIXES.get(Path(options.output or "").suffix, "text")
    make = makers.get(kind) or BAG_FORMATS.load(kind)
    text = make(load_with_messages(options, reads_plugins=False)[0])
    if options.output is None:
        print(text)
        return 0
    try:
        Path(options.output).write_text(text, "utf-8")
    except OSError as error:
        raise UsageError(f"-o {options.output}: cannot be written ({error.strerror})") from error
    return 0


_TEMPLATE = PACKAGE / "cli" / "template"
# Relative to the folder that a project is copied from.
_SCHEMA = re.compile(r'(?<="\$schema": ")[./]*/schema/')
_IN_GALLERY = re.compile(r"^## \[.*\]\((.*)/README\.md\)\n\n([^.]*\.(?=\s))", re.MULTILINE)


def add_new(new: argparse.ArgumentParser) -> None:
    new.description = (
        "Make a folder with a small project that runs: two plugins in a closed loop, and a test;"
        " or a robot of yours in MuJoCo, with drives and sensors, and a brain that moves it."
    )
    new.add_argument(
        "folder",
        nargs="?",
        type=Path,
        metavar="FOLDER",
        help="a new or empty folder (default with --robot: the name of its file)",
    )
    new.add_argument("--robot", type=Path, metavar="FILE", help="a robot in URDF, SDF or MJCF")
    new.add_argument(
        "--base",
        choices=["free", "fixed"],
        help="whether the robot moves (wheels, legs), or is held (an arm), where its file does not"
        " say so; asked for on a terminal",
    )
    new.add_argument(
        "--drive",
        choices=["position", "velocity", "motor", "none"],
        help="the drive of every joint (default: position; velocity for joints without limits)",
    )
    new.set_defaults(command=_new)


def _new(options: argparse.Namespace) -> int:
    robot, folder = options.robot, options.folder
    if robot is None:
        if folder is None:
            raise UsageError("name a folder for the project, or a robot with --robot FILE")
        if options.base or options.drive:
            raise UsageError("--base and --drive belong to --robot FILE")
        _copy(_TEMPLATE, folder, {})
        print(f"made {folder}; the next command: neuros launch {folder}")
        return 0
    if not robot.is_file():
        raise UsageError(f"--robot {robot}: there is no such file")
    folder = folder or Path(robot.name.partition(".")[0])
    # First into a folder beside: after an error there is none.
    with _making(folder):
        format_ = MODELS.load(robot.suffix.lower()[1:])
        choices = RobotChoices(options.base, options.drive)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".new-", dir=folder.parent) as draft:
            inside = Path(draft) / folder.name
            inside.mkdir()
            rows = format_.make_project(robot, inside, os.environ, choices)
            shutil.copytree(inside, folder, dirs_exist_ok=True)
    print("\n".join(rows))
    print(f"made {folder}; the next command: neuros launch {folder} --dashboard")
    return 0


def add_example(example: argparse.ArgumentParser) -> None:
    example.description = (
        "List the examples, or copy one into a folder, where it can be run and changed."
    )
    example.add_argument("name", nargs="?", metavar="NAME", help="the example to copy")
    example.add_argument(
        "folder",
        nargs="?",
        type=Path,
        metavar="FOLDER",
        help="a new or empty folder (default: NAME, in the current folder)",
    )
    add_format(example)
    example.set_defaults(command=_example)


def _example(options: argparse.Namespace) -> int:
    # In the order of the gallery, each with the first sentence about it.
    gallery = _IN_GALLERY.findall((EXAMPLES / "README.md").read_text("utf-8"))
    folders = {Path(inside).name: EXAMPLES / inside for inside, _ in gallery}
    descriptions = {Path(inside).name: " ".join(text.split()) for inside, text in gallery}
    name = options.name
    if name is None and options.format == JSON:
        rows = [(each, descriptions[each], folders[each]) for each in folders]
        print_json([dict(zip(("name", "description", "folder"), row, strict=True)) for row in rows])
    elif name is None:
        for each in folders:
            print(f"{each:18} {descriptions[each]}")
        print("\nneuros example NAME copies one into a folder of its own")
    elif name in folders:
        folder = options.folder or Path(name)
        # The commands on its pages are for the folder of the copy.
        inside = folders[name].relative_to(EXAMPLES.parent)
        renamed = {f"{inside}": f"{folder}", "./launch.py": "neuros launch", ".venv/bin/": ""}
        _copy(folders[name], folder, renamed)
        files = sorted({*folder.glob("*.json")} - {folder / "project.json"})
        others = [file.name for file in files if "nodes" in json.loads(file.read_text("utf-8"))]
        print(f"copied to {folder}; the next command: neuros launch {folder}")
        if others:
            print(
                f"{len(others)} variants of it, such as neuros launch {folder / others[0]}:"
                f" {folder / 'README.md'} says what each shows"
            )
    else:
        hint = did_you_mean(name, folders) or f"there are {', '.join(folders)}"
        raise UsageError(f"there is no example '{name}' ({hint})")
    return 0


@contextmanager
def _making(folder: Path) -> Iterator[None]:
    """Raise ``UsageError`` if there is something in a folder already, or it cannot be made."""
    try:
        if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise UsageError(f"{folder} exists already: name another folder")
        yield
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"{folder} cannot be made ({reason}): name another folder") from error


def _copy(source: Path, folder: Path, renamed: Mapping[str, str]) -> None:
    """Copy a project folder; ``renamed`` holds for its pages and Python files.

    Raises:
        UsageError: if there is something in the folder already, or it cannot be written.
    """
    with _making(folder):
        skipped = shutil.ignore_patterns("__pycache__", "runs")
        shutil.copytree(
            source, folder, ignore=skipped, copy_function=shutil.copyfile, dirs_exist_ok=True
        )
        for file in (*folder.rglob("*.json"), *folder.rglob("*.md"), *folder.rglob("*.py")):
            text = _SCHEMA.sub(f"{(PACKAGE / 'schema').as_uri()}/", file.read_text("utf-8"))
            for old, new in renamed.items():
                text = text.replace(old, new)
            file.write_text(text, "utf-8")
