"""``neuros benchmark`` and ``neuros reproduce``, whose options and programs are in the checkout."""

from __future__ import annotations

import argparse
import importlib
import sys

from neuros.distribution import ROOT
from neuros.errors import EnvironmentFault

_OPTIONS = "benchmarks.options"


def add_benchmark(benchmark: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    _add_options(benchmark, "add_benchmark")


def add_reproduce(reproduce: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    _add_options(reproduce, "add_reproduce")


def _add_options(parser: argparse.ArgumentParser, name: str) -> None:
    """Have the checkout add its options.

    Raises:
        EnvironmentFault: where neuros was installed without a checkout.
    """
    if not (ROOT / _OPTIONS.replace(".", "/")).with_suffix(".py").is_file():
        raise EnvironmentFault(
            f"there are no benchmarks in {ROOT}: they are part of the source checkout and not of"
            " the package; clone it, run ./install.py there, and use its .venv/bin/neuros"
        )
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    getattr(importlib.import_module(_OPTIONS), name)(parser)
