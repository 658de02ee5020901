"""``--format json``: what a command says, for programs. ``docs/command_line.md`` has the keys."""

from __future__ import annotations

import argparse
import dataclasses
import enum
import json
from pathlib import Path
from typing import Any

JSON = "json"


def add_format(command: argparse.ArgumentParser) -> None:
    """Add ``--format``, ``"text"`` or :data:`JSON`."""
    command.add_argument(
        "--format",
        choices=("text", JSON),
        default="text",
        help="text, or JSON for programs (default: text)",
    )


def print_json(value: Any) -> None:
    """Print one JSON value: of dataclasses their fields, of enumerations their names."""
    print(json.dumps(value, indent=2, default=_plain), flush=True)


def _plain(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, Path):
        return str(value)
    return {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
