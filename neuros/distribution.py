"""Version and folders of the NeuROS that is imported."""

from pathlib import Path

__version__ = "2.0.0"

PACKAGE = Path(__file__).resolve().parent
"""The folder of the package ``neuros``."""

ROOT = PACKAGE.parent
"""The source checkout, where NeuROS is installed from one."""

WORKSPACE = ROOT / "workspace"
"""``@path`` in project files is relative to it."""
