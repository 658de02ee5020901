"""``neuros reproduce``, with an experiment that costs nothing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.reproduce import command
from benchmarks.reproduce.experiment import Entry, Experiment
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.tables import Layout, Ours
from neuros.cli import machine
from neuros.cli.main import main

PARTS = {"good": "Good", "bad": "Bad", "interrupted": "Interrupted"}


class Cheap:
    """Runs that write a number; two of the parts do not work."""

    def __init__(self) -> None:
        self.started: list[str] = []
        self.backends: set[str] = set()

    def run(self, name: str, folder: Path, seconds: float, backend: str) -> None:
        self.started.append(folder.name)
        self.backends.add(backend)
        if name == "interrupted":
            folder.mkdir(parents=True)
            raise KeyboardInterrupt
        if name == "bad":
            raise RuntimeError("neuros launch bad.json: exit code 1\nmany\nlines\nit broke <here>")
        folder.mkdir(parents=True)
        (folder / "number").write_text(str(seconds))

    def read(self, folder: Path, entry: Entry) -> Reading:
        figures = {"number": float((folder / "number").read_text())}
        return Reading(entry.title, entry.name, figures, {"backend": "none"}, None)

    def show(self, readings: Readings, folder: Path) -> Sequence[Section]:
        picture = folder / "picture.png"
        picture.write_bytes(b"PNG")
        table = Layout("numbers", [Ours("number", "number")]).fill(PARTS, readings)
        return [Section("Numbers", ["<what>"], table, [picture])]


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> Cheap:
    """An experiment instead of the real ones."""
    runs = Cheap()
    kind = Kind("Cheap", "Nothing much.", PARTS, runs.run, runs.read, runs.show)
    monkeypatch.setattr(command, "_kind", lambda name: kind)
    monkeypatch.setattr("benchmarks.reproduce.running.load_before", lambda: 0.25)
    return runs


def reproduce(folder: Path, *more: str) -> int:
    return main(["reproduce", "tick", "-o", str(folder), "--duration", "3", *more])


def test_runs_tables_figures_and_a_page_are_in_the_folder(cheap: Cheap, tmp_path: Path) -> None:
    assert reproduce(tmp_path, "--only", "good", "--repeat", "2", "--backend", "process") == 0

    assert cheap.started == ["good-1", "good-2"]
    assert cheap.backends == {"process"}
    page = (tmp_path / "index.md").read_text()
    assert "on other machines and with another simulator" in page
    assert "3 s each; 2 runs" in page
    assert "others kept 25% to 25%" in page
    assert "| Good |      3.0 |" in page
    assert "![Numbers](figures/picture.png)" in page
    alone = (tmp_path / "index.html").read_text()
    assert "&lt;what&gt;" in alone
    assert 'src="data:image/png;base64,UE5H"' in alone
    assert (tmp_path / "tables/numbers.csv").read_text().splitlines() == [",number", "Good,3.0"]
    assert "| Good |      3.0 |" in (tmp_path / "tables/numbers.md").read_text()
    assert (tmp_path / "tables/runs.csv").read_text().splitlines() == [
        "run,backend,number",
        "good-1,none,3.0",
        "good-2,none,3.0",
    ]


def test_a_run_that_fails_is_named_and_the_others_go_on(
    cheap: Cheap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reproduce(tmp_path, "--only", "good", "bad", "--repeat", "2") == 1

    assert cheap.started == ["good-1", "bad-1", "bad-2", "good-2"]  # there and back
    assert "FAILED: bad-1: it broke <here>" in capsys.readouterr().err
    assert "## Runs that failed\n\nbad-1: it broke <here>" in (tmp_path / "index.md").read_text()
    assert "it broke &lt;here&gt;" in (tmp_path / "index.html").read_text()


def test_ctrl_c_keeps_the_runs_that_had_ended(cheap: Cheap, tmp_path: Path) -> None:
    assert reproduce(tmp_path, "--only", "good", "interrupted") == 130

    assert [each.title for each in Experiment.open(tmp_path, "tick").runs] == ["good-1"]
    assert "| Good |      3.0 |" in (tmp_path / "index.md").read_text()


def test_runs_are_added_to_a_folder_of_an_earlier_call(cheap: Cheap, tmp_path: Path) -> None:
    reproduce(tmp_path, "--only", "interrupted")
    reproduce(tmp_path, "--only", "good")
    assert reproduce(tmp_path, "--only", "good", "interrupted") == 130

    assert cheap.started == ["interrupted-1", "good-1", "good-2", "interrupted-2"]
    assert "2 runs" in (tmp_path / "index.md").read_text()


def test_tables_and_figures_are_made_again_without_running(cheap: Cheap, tmp_path: Path) -> None:
    reproduce(tmp_path, "--only", "good")
    (tmp_path / "index.md").unlink()

    assert main(["reproduce", "tick", "--from", str(tmp_path)]) == 0

    assert cheap.started == ["good-1"]
    assert "| Good |      3.0 |" in (tmp_path / "index.md").read_text()


def test_a_run_that_is_no_longer_there_is_named(
    cheap: Cheap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reproduce(tmp_path, "--only", "good")
    (tmp_path / "runs/good-1/number").unlink()
    capsys.readouterr()

    assert main(["reproduce", "tick", "--from", str(tmp_path)]) == 2

    error = capsys.readouterr().err
    assert error.startswith(f"neuros: {tmp_path}/runs/good-1/number cannot be read (No such file")
    assert "run good-1" in error


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (["--only", "nobody"], "--only nobody: there is no such part (there are good, bad, "),
        (["--from", "somewhere"], "--from runs nothing: leave out all other options"),
    ],
)
def test_wrong_usage_is_one_sentence(
    cheap: Cheap,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    reason: str,
) -> None:
    assert reproduce(tmp_path / "new", *more) == 2
    assert capsys.readouterr().err.startswith(f"neuros: {reason}")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "long"])
def test_a_duration_is_a_positive_number(value: str) -> None:
    with pytest.raises(SystemExit):
        main(["reproduce", "tick", "--duration", value])


def test_a_run_that_is_too_short_to_tell_anything_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command_line = ["reproduce", "tick", "--duration", "2", "-o", str(tmp_path / "new")]
    assert main(command_line) == 2
    assert "--duration 2: a run lasts at least 3 s" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_folder_with_something_else_is_left_alone(
    cheap: Cheap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    assert reproduce(tmp_path) == 2
    assert "holds something else; name a new folder" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["thesis.txt"]


def test_runs_of_another_duration_machine_or_version_are_not_mixed(
    cheap: Cheap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reproduce(tmp_path, "--only", "good")
    capsys.readouterr()
    command_line = ["reproduce", "tick", "-o", str(tmp_path), "--duration", "4"]
    assert main(command_line) == 2
    assert "must not be mixed with (duration there 3 s, now 4 s)" in capsys.readouterr().err

    there = Experiment.open(tmp_path, "tick")
    replace(there, machine={**there.machine, "processor": "another"}).write()
    assert reproduce(tmp_path, "--only", "good") == 2
    assert "mixed with (processor there another, now " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "is no folder of `neuros reproduce tick`"),
        ("{", "is broken"),
        ("[]", "is broken"),
        (json.dumps({"format": 1, "name": "whiskeye"}), "is format 1 of experiment whiskeye"),
        (json.dumps({"format": 1, "name": "tick", "runs": []}), "is broken"),
    ],
)
def test_another_folder_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None, reason: str
) -> None:
    if content is not None:
        (tmp_path / "reproduce.json").write_text(content)
    assert main(["reproduce", "tick", "--from", str(tmp_path)]) == 2
    assert reason in capsys.readouterr().err


def test_without_a_source_checkout_it_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    assert main(["reproduce", "tick"]) == 4
    assert f"no benchmarks in {tmp_path}: they are part of the source" in capsys.readouterr().err
