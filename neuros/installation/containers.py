"""Images that nodes run in, and message packages, built by the NeuROS that was just installed."""

from __future__ import annotations

import argparse
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from neuros.installation.machine import clean_environment


def build_containers(python: Path, options: argparse.Namespace) -> int:
    """Build what is missing or out of date; returns an exit code.

    Where nothing was asked for by name, a machine without Docker gets a line about it, and that is
    all.
    """
    command = [str(python), "-m", "neuros.cli", *build_arguments(options)]
    return subprocess.call(command, env=clean_environment(os.environ))


def build_messages(python: Path, root: Path) -> int:
    """Build the message packages of NeuROS's workspace; returns an exit code.

    A machine without a C compiler gets a line about it, and that is all.
    """
    command = [str(python), "-m", "neuros.cli", "build", "--if-compiler"]
    return subprocess.call(command, cwd=root, env=clean_environment(os.environ))


def build_arguments(options: argparse.Namespace) -> Sequence[str]:
    """The options of ``neuros containers build`` for those of ``install.py``."""
    arguments = ["containers", "build", *(options.containers or ["--if-engine"])]
    for image in options.base_image:
        arguments += ["--base-image", image]
    if options.wheelhouse:
        arguments += ["--wheelhouse", options.wheelhouse]
    if options.ca_bundle:
        arguments += ["--ca-bundle", options.ca_bundle]
    return [*arguments, *(["--pull"] if options.pull else [])]
