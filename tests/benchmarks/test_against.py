"""A commit beside another one: which rows are slower, beyond the noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks import against
from benchmarks.against import Pair
from neuros.cli.main import main

ROUNDS = 6


def pair(here: Sequence[float], there: Sequence[float], unit: str = "us") -> Pair:
    return Pair("round trip", unit, tuple(here), tuple(there))


@pytest.mark.parametrize(
    ("here", "unit", "verdict"),
    [
        ([110] * ROUNDS, "us", "slower"),
        ([110] * ROUNDS, "1/s", "faster"),
        ([90] * ROUNDS, "1/s", "slower"),
        ([104] * ROUNDS, "us", ""),
        ([90, 95, 100, 105, 110, 130], "us", ""),
        ([110] * (ROUNDS - 1), "us", ""),  # too few rounds for an interval
        ([200] * ROUNDS, "", ""),
    ],
)
def test_a_row_is_slower_if_its_whole_interval_is(
    here: Sequence[float], unit: str, verdict: str
) -> None:
    assert pair(here, [100] * len(here), unit).verdict == verdict


@pytest.fixture
def trees(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """Another commit, in which a round takes 100 us; here it takes 120. Returns who measured."""
    measured: list[Path] = []

    def rows(tree: Path, arguments: Sequence[str]) -> list[dict[str, Any]]:
        measured.append(tree)
        value = 100.0 if tree == tmp_path else 120.0
        return [{"subject": "good", "name": "round trip", "unit": "us", "values": [value]}]

    monkeypatch.setattr(against, "installed", lambda commit, say: tmp_path)
    monkeypatch.setattr(against, "_rows", rows)
    return measured


def test_rounds_of_both_are_interleaved(trees: list[Path], tmp_path: Path) -> None:
    (found,) = against.measure("main", ["good"], lambda _: None, rounds=2)
    assert [tree == tmp_path for tree in trees] == [False, True, True, False]
    assert (found.here, found.there) == ((120.0, 120.0), (100.0, 100.0))


def test_a_slower_row_is_exit_code_1(trees: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "good", "--against", "main", "--quick"]) == 1
    assert "1.2 (1.2 to 1.2)" in capsys.readouterr().out


def test_a_commit_that_is_none_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--against", "no-such-commit"]) == 2
    assert capsys.readouterr().err == "neuros: --against: there is no such commit\n"
