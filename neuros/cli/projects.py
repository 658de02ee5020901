"""``neuros validate``, ``graph`` and ``types``, and the project that a command names.

What reads projects is imported late: ``--help`` and completion read this module, too.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.api.request import ProjectOptions
from neuros.cli.output import JSON, add_format, print_json
from neuros.errors import NeurosError, ProjectError, UsageError
from neuros.options import add_options, options_of

if TYPE_CHECKING:
    from neuros.messages.needed import Messages
    from neuros.project.model import Project

EXIT_NODE = 1
EXIT_PROJECT = 3
_GRAPH_SUFFIXES = {".svg": "svg", ".mmd": "mermaid", ".mermaid": "mermaid"}


def add_project(command: argparse.ArgumentParser, declared_in: type = ProjectOptions) -> None:
    """Add what names a project, and the options that a dataclass declares."""
    command.add_argument(
        "project", nargs="?", metavar="PROJECT", help="a file, or a folder with a project.json"
    )
    command.add_argument(
        "-p", "--project", dest="project_option", metavar="PROJECT", help="another way to name it"
    )
    add_options(command, options_of(declared_in))


def project_path(parsed: argparse.Namespace) -> Path:
    """The project that was named, once.

    Raises:
        UsageError: if none or two were named.
    """
    named = {path for path in (parsed.project, parsed.project_option) if path is not None}
    if not named:
        raise UsageError("name a project: a file, or a folder with a project.json")
    if len(named) > 1:
        raise UsageError(f"two projects are named: {' and '.join(sorted(named))}")
    return Path(named.pop())


def load_with_messages(
    parsed: argparse.Namespace, *, reads_plugins: bool = True
) -> tuple[Project, Messages]:
    """Load the project and find its message packages; warnings go to standard error.

    Raises:
        ProjectError: with all its problems, and those of its message files.
    """
    from neuros.api.loading import load_with_messages as load

    path = project_path(parsed)
    changes = (parsed.set, parsed.namespace, parsed.remap)
    loaded, messages = load(path, *changes, reads_plugins=reads_plugins)
    for warning in loaded.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return loaded.project, messages


def add_validate(validate: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
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
    if parsed.format == JSON:
        return _validate_for_programs(parsed)
    project = _validated(parsed)
    print(
        f"{project.file}: valid: {_count(len(project.nodes), 'node')},"
        f" {_count(len(project.connections), 'connection')}"
    )
    return 0


def _validate_for_programs(parsed: argparse.Namespace) -> int:
    try:
        _validated(parsed)
    except ProjectError as error:
        print_json({"is_valid": False, "problems": error.problems})
        return EXIT_PROJECT
    print_json({"is_valid": True, "problems": []})
    return 0


def _validated(parsed: argparse.Namespace) -> Project:
    """The project, without a problem. Raises ``ProjectError``."""
    from neuros.api.validation import import_problems, model_problems

    project, messages = load_with_messages(parsed)
    problems = model_problems(project)
    if not problems and parsed.imports:
        problems = import_problems(project, messages, project_path(parsed), parsed.set)
    if problems:
        raise ProjectError(problems)
    return project


def add_import_plugin(command: argparse.ArgumentParser) -> None:
    """Add the arguments of what ``validate --import`` runs for each node."""
    command.add_argument("name")
    command.add_argument("project")
    command.add_argument("--set", action="append", default=[])
    command.add_argument("--answer", type=int, required=True)
    command.set_defaults(command=_import_plugin)


def _import_plugin(options: argparse.Namespace) -> int:
    """Import the plugin of one node as a run would; what is wrong with it is the answer."""
    from neuros.testing import PluginHarness

    with os.fdopen(options.answer, "w", encoding="utf-8", errors="backslashreplace") as answer:
        try:
            PluginHarness.from_project(options.project, options.name, overrides=options.set)
        except NeurosError as error:
            answer.write(str(error))
            return EXIT_NODE
    return 0


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def add_graph(graph: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
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
    """Add the options of the command."""
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
        files = write_stubs({port.type for port in ports}, folder)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror})") from error
    print(f"{folder}: {_count(len(files), 'package')} of messages")
    return 0


def _graph(options: argparse.Namespace) -> int:
    """Write the graph of a project. Raises ``UsageError`` if the file cannot be written."""
    from neuros.project.graph import graph_mermaid, graph_text
    from neuros.project.graph_svg import graph_svg

    makers = {"text": graph_text, "mermaid": graph_mermaid, "svg": graph_svg}
    kind = options.format or _GRAPH_SUFFIXES.get(Path(options.output or "").suffix, "text")
    text = makers[kind](load_with_messages(options, reads_plugins=False)[0])
    if options.output is None:
        print(text)
        return 0
    try:
        Path(options.output).write_text(text, "utf-8")
    except OSError as error:
        raise UsageError(f"-o {options.output}: cannot be written ({error.strerror})") from error
    return 0
