"""Message packages of a project under test: built, and found by this very Python."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from neuros.errors import ProjectError
from neuros.installation.progress import Progress
from neuros.launch.node_command import without_mark
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.project.model import Node


def workspaces_of(project: Path, workspace: Path) -> Workspaces:
    """What a project in this folder sees besides the packages of ROS."""
    return Workspaces(project.resolve() / "workspace", workspace, os.environ)


def provide_messages(node: Node, workspaces: Workspaces) -> tuple[Path, ...]:
    """Build what a node needs; returns where Python finds it from now on.

    Raises:
        ProjectError: with all mistakes in message files.
        EnvironmentFault: if they cannot be built.
    """
    messages = Messages.of_nodes([node], workspaces)
    if problems := messages.problems():
        raise ProjectError(problems)
    if not messages.is_made:
        messages.make(Progress(sys.stderr), without_mark(os.environ))
    sys.path[:0] = [path for path in map(str, messages.paths) if path not in sys.path]
    return messages.paths
