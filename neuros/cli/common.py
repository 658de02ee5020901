"""Shared by commands: ``--format json``, and the project that a command names.

``docs/command_line.md`` has the keys of JSON. Modules that read projects are imported late:
``--help`` and completion import this one, too.
"""

from __future__ import annotations

import argparse
import dataclasses
import enum
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.api.request import ProjectOptions
from neuros.errors import Problem, UsageError
from neuros.options import add_options, options_of

if TYPE_CHECKING:
    from neuros.messages.needed import Messages
    from neuros.project.model import Project

JSON = "json"


def add_format(command: argparse.ArgumentParser) -> None:
    """Add ``--format``, ``"text"`` or :data:`JSON`."""
    command.add_argument(
        "--format",
        choices=("text", JSON),
        default="text",
        help="text, or JSON for programs (default: text)",
    )


def print_json(value: Any) -> None:
    """Print one JSON value; a dataclass becomes its fields, a member of an enumeration its name."""
    print(json.dumps(value, indent=2, default=_plain), flush=True)


def _plain(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, Path):
        return str(value)
    return {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}


def add_project(command: argparse.ArgumentParser, declared_in: type = ProjectOptions) -> None:
    """Add the project, and the options that a dataclass declares."""
    command.add_argument(
        "project", nargs="?", metavar="PROJECT", help="a file, or a folder with a project.json"
    )
    command.add_argument(
        "-p", "--project", dest="project_option", metavar="PROJECT", help="another way to name it"
    )
    add_options(command, options_of(declared_in))


def project_path(parsed: argparse.Namespace) -> Path:
    """The path of the project on the command line.

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
    project, messages, warnings = load_quietly(parsed, reads_plugins=reads_plugins)
    show_warnings(warnings)
    return project, messages


def show_warnings(warnings: Iterable[Problem]) -> None:
    """Write them to standard error."""
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)


def load_quietly(
    parsed: argparse.Namespace, *, reads_plugins: bool = True
) -> tuple[Project, Messages, Sequence[Problem]]:
    """Load the project, its message packages, and warnings. Raises as the one above."""
    from neuros.api.loading import load_with_messages as load

    path = project_path(parsed)
    changes = (parsed.set, parsed.namespace, parsed.remap, parsed.time, parsed.timing)
    loaded, messages = load(path, *changes, reads_plugins=reads_plugins)
    return loaded.project, messages, loaded.warnings
