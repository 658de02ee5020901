"""The documentation, built by the environment that was just installed."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from neuros.installation.machine import clean_environment


def build_documentation(python: Path, root: Path) -> int:
    """Build ``docs/build/html``; returns an exit code. What is wrong is said by Sphinx."""
    command = [str(python), str(root / "docs" / "make.py")]
    return subprocess.call(command, env=clean_environment(os.environ))
