"""``neuros validate`` and ``neuros graph``, and the loading of the project that a command names."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from neuros.api.loading import load_with_messages as load_by_path
from neuros.api.validation import import_problems, model_problems
from neuros.errors import NeurosError, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.project.model import Project

EXIT_NODE = 1
_GRAPH_SUFFIXES = {".svg": "svg", ".mmd": "mermaid", ".mermaid": "mermaid"}


def project_path(options: argparse.Namespace) -> Path:
    """The project that was named, once.

    Raises:
        UsageError: if none or two were named.
    """
    named = {path for path in (options.project, options.project_option) if path is not None}
    if not named:
        raise UsageError("name a project: a file, or a folder with a project.json")
    if len(named) > 1:
        raise UsageError(f"two projects are named: {' and '.join(sorted(named))}")
    return Path(named.pop())


def load(options: argparse.Namespace, *, reads_plugins: bool = True) -> Project:
    """Load the project as :func:`load_with_messages` does."""
    return load_with_messages(options, reads_plugins=reads_plugins)[0]


def load_with_messages(
    options: argparse.Namespace, *, reads_plugins: bool = True
) -> tuple[Project, Messages]:
    """Load the project and find its message packages; warnings go to standard error.

    Raises:
        ProjectError: with all its problems, and those of its message files.
    """
    loaded, messages = load_by_path(
        project_path(options),
        options.set,
        options.namespace,
        options.remap,
        reads_plugins=reads_plugins,
    )
    for warning in loaded.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return loaded.project, messages


def validate(options: argparse.Namespace) -> int:
    """Check a project, and say that it is valid."""
    project, messages = load_with_messages(options)
    problems = model_problems(project)
    if not problems and options.imports:
        problems = import_problems(project, messages, project_path(options), options.set)
    if problems:
        raise ProjectError(problems)
    print(
        f"{project.file}: valid: {_count(len(project.nodes), 'node')},"
        f" {_count(len(project.connections), 'connection')}"
    )
    return 0


def import_plugin(options: argparse.Namespace) -> int:
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


def write_graph(options: argparse.Namespace) -> int:
    """Write the graph of a project to the terminal, or to a file.

    Raises:
        UsageError: if the file cannot be written.
    """
    from neuros.project.graph import graph_mermaid, graph_text
    from neuros.project.graph_svg import graph_svg

    makers = {"text": graph_text, "mermaid": graph_mermaid, "svg": graph_svg}
    kind = options.format or _GRAPH_SUFFIXES.get(Path(options.output or "").suffix, "text")
    text = makers[kind](load(options, reads_plugins=False))
    if options.output is None:
        print(text)
        return 0
    try:
        Path(options.output).write_text(text, "utf-8")
    except OSError as error:
        raise UsageError(f"-o {options.output}: cannot be written ({error.strerror})") from error
    return 0
