"""``neuros build``: message packages of workspaces, built without a ROS distribution."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from neuros.errors import EnvironmentFault, ProjectError, UsageError


def add_build(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    build = commands.add_parser(
        "build",
        help="build message packages",
        description="Build the ROS packages with messages, services and actions of a workspace"
        " that are not built yet, and those of NeuROS's own. Launching a project does it, too.",
        epilog="exit codes: 0 all are built, 2 no such package, 3 every mistake in a file is listed"
        " with its line, 4 no compiler, or it fails",
    )
    build.add_argument("packages", nargs="*", metavar="PACKAGE", help="these only (default: all)")
    build.add_argument(
        "-p",
        "--project",
        metavar="PROJECT",
        help="whose workspace, a folder beside the project file (default: that of this folder)",
    )
    # For install.py: a machine without a compiler can do all the rest.
    build.add_argument("--if-compiler", action="store_true", help=argparse.SUPPRESS)
    build.set_defaults(command=_build)


def _build(options: argparse.Namespace) -> int:
    from neuros.api.loading import workspaces_of
    from neuros.api.workspace import WORKSPACE
    from neuros.cli.environments import build_messages
    from neuros.messages.compilation import Compilers
    from neuros.messages.needed import Messages
    from neuros.project.suggest import did_you_mean

    project = Path(options.project or os.curdir)
    if not project.exists():
        raise UsageError(f"build: there is no project {project}")
    workspaces = workspaces_of(project)
    for name in options.packages:
        if name not in workspaces.packages and not workspaces.problems:
            hint = did_you_mean(name, workspaces.packages) or "it needs a package.xml and msg/*.msg"
            raise UsageError(f"build: no workspace has a message package '{name}' ({hint})")
    messages = Messages(workspaces, options.packages or workspaces.packages)
    if problems := [*messages.problems(), *workspaces.problems]:
        raise ProjectError(problems)
    if options.if_compiler and not messages.is_made:
        try:
            Compilers.here()
        except EnvironmentFault as fault:
            print(f"message packages are not built: {fault}")
            return 0
    if ended := build_messages(messages):
        return ended
    for built in messages.built:
        print(f"messages of {built.package} are built: {built.folder}")
    if not messages.built:
        folder = project if project.is_dir() else project.parent
        print(f"no message packages in {folder / 'workspace'} and {WORKSPACE}")
    return 0
