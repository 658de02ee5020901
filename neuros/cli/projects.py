"""Finding and loading the project that a command names."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from neuros.errors import UsageError
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
    """Load the project; its warnings go to standard error.

    Raises:
        ProjectError: with all its problems.
    """
    loaded = load_project(project_path(options), workspace=WORKSPACE, overrides=options.set)
    for warning in loaded.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return loaded.project
