"""NeuROS gets no larger: each number is a ceiling, which falls with what it holds down."""

from __future__ import annotations

from pathlib import Path

import pytest
from sizes import (
    ROOT,
    calls_of_a_node,
    classes_in_several_modules,
    lines,
    sources,
    used_once_percent,
)

NEUROS = ROOT / "neuros"
EXTENSIONS = [*(ROOT / "extensions").glob("*/neuros_*")]
TESTS = [ROOT / "tests", *(ROOT / "extensions").glob("*/tests")]
SLACK = 0.02
"""A number that has fallen by more than this share takes its ceiling with it."""


def hold(what: str, found: float, ceiling: float) -> None:
    """Fail if a number is over its ceiling, or so far below that the ceiling is out of date."""
    assert found <= ceiling, f"{what}: {found:g}, and {ceiling:g} is the ceiling: make it smaller"
    assert found >= (1 - SLACK) * ceiling - 1, f"{what}: {found:g}: lower the ceiling in this test"


def test_lines_of_the_core() -> None:
    hold("lines of neuros/", lines(NEUROS), 53_520)


def test_lines_of_the_core_and_its_extensions() -> None:
    hold("lines of neuros/ and extensions/", lines(NEUROS, *EXTENSIONS), 71_600)


def test_lines_of_tests_and_benchmarks() -> None:
    hold("lines of tests/ and benchmarks/", lines(*TESTS, ROOT / "benchmarks"), 90_460)
