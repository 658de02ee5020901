"""Finding and loading the project that a command names."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from neuros.api import loading
from neuros.errors import UsageError
from neuros.launch.containers import misspelt
from neuros.messages.needed import Messages
from neuros.project.model import Project


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
    loaded, messages = loading.load_with_messages(
        project_path(options),
        options.set,
        options.namespace,
        options.remap,
        reads_plugins=reads_plugins,
    )
    for warning in loaded.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for node in loaded.project.nodes:
        if meant := misspelt(node.container, loaded.project.folder):
            text = f"there is no container '{node.container}' (did you mean '{meant}'?)"
            print(f"warning: node '{node.name}': {text}", file=sys.stderr)
    return loaded.project, messages
