"""Where ROS packages with messages of the user's own are."""

from pathlib import Path

WORKSPACE = Path(__file__).resolve().parents[2] / "workspace"
"""``@path`` in project files is relative to it."""
