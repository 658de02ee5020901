"""Commands that belong to the source checkout, and not to the package: found where it is."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from neuros.errors import EnvironmentFault

ROOT = Path(__file__).resolve().parents[2]


def checkout_command(name: str) -> Any:
    """The module of a command, such as ``benchmarks.command``.

    Raises:
        EnvironmentFault: where neuros was installed without a checkout.
    """
    if not ROOT.joinpath(*name.split(".")).with_suffix(".py").is_file():
        raise EnvironmentFault(
            f"there are no benchmarks in {ROOT}: they are part of the source checkout;"
            " clone it, run ./install.py there, and use its .venv/bin/neuros"
        )
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    return importlib.import_module(name)


def positive_number(text: str) -> int:
    """An argument that counts something. Raises ``ValueError``, which argparse reports."""
    number = int(text)
    if number < 1:
        raise ValueError(text)
    return number
