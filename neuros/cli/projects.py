"""Finding and loading the project that a command names."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from neuros.errors import ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.project.load import load_project
from neuros.project.model import Project

WORKSPACE = Path(__file__).resolve().parents[2] / "workspace"
"""ROS packages with messages of the user's own; ``@path`` in project files is relative to it."""


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


def load(options: argparse.Namespace) -> Project:
    """Load the project as :func:`load_with_messages` does."""
    return load_with_messages(options)[0]


def load_with_messages(options: argparse.Namespace) -> tuple[Project, Messages]:
    """Load the project and find its message packages; warnings go to standard error.

    Raises:
        ProjectError: with all its problems, and those of its message files.
    """
    path = project_path(options)
    workspaces = workspaces_of(path)
    try:
        loaded = load_project(
            path,
            workspace=WORKSPACE,
            overrides=options.set,
            packages=workspaces,
            namespace=options.namespace,
            remap=options.remap,
        )
    except ProjectError as error:
        problems = Messages(workspaces, workspaces.own).problems()
        raise ProjectError([*error.problems, *problems]) from None
    for warning in loaded.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    messages = Messages.of_nodes(loaded.project.nodes, workspaces)
    if problems := messages.problems():
        raise ProjectError(problems)
    return loaded.project, messages


def workspaces_of(project: Path) -> Workspaces:
    """The workspaces that a project, a file or a folder, sees."""
    folder = project if project.is_dir() else project.parent
    return Workspaces(folder.resolve() / "workspace", WORKSPACE, os.environ)
