"""``neuros benchmark``, with subjects that cost nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from benchmarks import dora, page, subjects
from benchmarks.measure import Case, Figure, Group, Subject, Unavailable
from benchmarks.results import Results
from benchmarks.targets import BOUNDS, TARGETS
from neuros.cli import machine
from neuros.cli.main import main
from neuros.errors import UsageError


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Two subjects instead of the real ones; returns the results file to be."""

    def load(chosen: list[str], is_quick: bool) -> dict[str, Subject]:
        case = Case("round trip", "us", Figure("a"), Figure("b"), "b", "hook")
        failing = Case("broken", "us", Figure("c"))
        whole = {
            "good": Subject("works", (Group({"a": lambda: 1.0, "b": lambda: 2.0}, (case,)),)),
            "bad": Subject("does not", (Group({"c": lambda: 1 / 0}, (failing,)),)),
        }
        return {name: whole[name] for name in chosen or whole}

    monkeypatch.setattr(subjects, "load", load)
    monkeypatch.setattr("benchmarks.running.load_before", lambda _: 0.0)
    return tmp_path / "results.json"


def test_it_measures_prints_and_keeps(cheap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "good", "--rounds", "10", "-o", str(cheap)]) == 0
    output = capsys.readouterr()
    assert re.search(
        r"^round trip +1 \(1 to 1\) us .* 0\.5 \(0\.5 to 0\.5\) +10 ", output.out, re.M
    )
    assert f"all values: {cheap}" in output.err
    (row,) = Results.read(cheap).rows
    assert row.values == (1.0,) * 10


def test_a_measurement_that_fails_is_exit_code_1(
    cheap: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--quick", "-o", str(cheap)]) == 1
    output = capsys.readouterr().out
    assert "FAILED: bad: broken: c failed 2 x: ZeroDivisionError: division by zero" in output
    assert "round trip" in output


def test_results_are_shown_without_measuring(
    cheap: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["benchmark", "good", "--rounds", "6", "-o", str(cheap)])
    capsys.readouterr()
    assert main(["benchmark", "--from", str(cheap)]) == 0
    assert "round trip" in capsys.readouterr().out


def test_the_numbers_page_keeps_what_people_wrote(cheap: Path, tmp_path: Path) -> None:
    main(["benchmark", "good", "--rounds", "6", "-o", str(cheap)])
    file = tmp_path / "numbers.md"
    file.write_text(f"# Numbers\n\n{page.BEGIN}\nold\n{page.END}\n\nWhy.\n")
    results = Results.read(cheap)
    results.versions["commit"] = "0123abc"
    for _ in range(2):  # the second time changes nothing
        page.write(results, tmp_path)
        text = file.read_text()
        assert text.startswith(f"# Numbers\n\n{page.BEGIN}\n\n### Targets\n")
        assert text.endswith(f"{page.END}\n\nWhy.\n")
        assert "old" not in text
        assert re.search(r"`neuros benchmark good` \(20.+ cores of .+, 0123abc\)", text)


def test_the_numbers_page_has_figures_of_commits_only(cheap: Path, tmp_path: Path) -> None:
    main(["benchmark", "good", "--rounds", "6", "-o", str(cheap)])
    results = Results.read(cheap)
    results.versions["commit"] = "0123abc+"
    with pytest.raises(UsageError, match="commit first"):
        page.write(results, tmp_path)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["nothing"], "no such subject: nothing (there are "),
        (["engine", "-k", "no such row"], "-k no such row: no row of engine"),
        (["engine", "--list"], "--from and --list measure nothing"),
        (["--from", "missing.json"], "missing.json: No such file"),
    ],
)
def test_wrong_usage_is_one_sentence(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", *arguments]) == 2
    assert capsys.readouterr().err.startswith(f"neuros: {reason}")


def test_without_a_source_checkout_it_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    assert main(["benchmark", "engine"]) == 4
    assert f"no benchmarks in {tmp_path}: they are part of the source" in capsys.readouterr().err


def test_without_dora_its_rows_are_left_out_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(Unavailable, match=r"not installed \(./install.py --extras benchmark\)"):
        dora.run("ping", "pong", {})


def test_a_real_subject_runs_in_a_moment(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    row = "engine alone, loop-back"
    assert main(["benchmark", "engine", "--quick", "-k", row, "-o", str(file)]) == 0
    (found,) = json.loads(file.read_text())["rows"]
    assert found["name"] == f"execution of a hook, {row}"
    assert len(found["values"]) == 2


# ------------------------------------------------------------------ what the subjects declare


@pytest.fixture(scope="module")
def declared() -> dict[str, Subject]:
    return subjects.load([], is_quick=False)


def test_every_bound_is_held_by_exactly_one_row_of_its_subject(
    declared: dict[str, Subject],
) -> None:
    held = [
        (name, case.bound)
        for name, subject in declared.items()
        for group in subject.groups
        for case in group.cases
        if case.bound
    ]
    wanted = [(target.subject, bound.key) for target in TARGETS for bound in target.bounds]
    assert sorted(held) == sorted(wanted)
    assert len(BOUNDS) == len(wanted)


def test_rows_name_what_their_group_measures_and_differ_in_name(
    declared: dict[str, Subject],
) -> None:
    for subject in declared.values():
        cases = [case for group in subject.groups for case in group.cases]
        assert len({case.name for case in cases}) == len(cases)
        for group in subject.groups:
            assert {name for case in group.cases for name in case.candidates} == {*group.candidates}


def test_a_target_is_judged_by_at_least_ten_rounds(declared: dict[str, Subject]) -> None:
    for subject in declared.values():
        for group in subject.groups:
            if any(case.bound for case in group.cases):
                assert group.rounds >= 10
