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
    hold("lines of neuros/", lines(NEUROS), 53_530)


def test_lines_of_the_core_and_its_extensions() -> None:
    hold("lines of neuros/ and extensions/", lines(NEUROS, *EXTENSIONS), 75_010)


def test_lines_of_tests_and_benchmarks() -> None:
    hold("lines of tests/ and benchmarks/", lines(*TESTS, ROOT / "benchmarks"), 94_400)


def test_private_functions_that_are_used_once() -> None:
    hold("percent of the functions of neuros/", used_once_percent(NEUROS), 6.68)


def test_public_classes_of_one_name() -> None:
    hold("names in several modules", classes_in_several_modules(NEUROS), 6)


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    return calls_of_a_node(tmp_path_factory.mktemp("calls"))


@pytest.mark.parametrize(
    ("what", "ceiling"),
    [
        ("calls of a round", 54),
        ("files of a round", 16),
        ("functions before a hook", 455),
        ("files before a hook", 55),
    ],
)
def test_calls_in_a_node(what: str, ceiling: int, calls: dict[str, int]) -> None:
    """Older Pythons name functions otherwise, and count fewer: there is no least number."""
    assert calls[what] <= ceiling


def test_a_source_is_counted_and_data_is_not(tmp_path: Path) -> None:
    for name in ("a.py", "sub/b.py", "examples/c.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x = 1\ny = 2\n")
    assert [path.name for path in sources(tmp_path)] == ["a.py", "b.py"]
    assert lines(tmp_path) == 4


def test_a_private_function_that_one_place_names_is_counted(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(
        "def _once(): ...\ndef _twice(): ...\ndef public(): ...\n_once(); _twice(); _twice()\n"
    )
    assert used_once_percent(tmp_path) == pytest.approx(100 / 3)
