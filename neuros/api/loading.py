"""Loads a project together with the message packages that it sees."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from neuros.api.workspace import WORKSPACE
from neuros.errors import ProjectError
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.project.load import Loaded, load_project


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
    return loaded, messages


def workspaces_of(project: Path) -> Workspaces:
    """The workspaces that a project, a file or a folder, sees."""
    folder = project if project.is_dir() else project.parent
    return Workspaces(folder.resolve() / "workspace", WORKSPACE, os.environ)
