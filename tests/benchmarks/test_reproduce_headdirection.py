"""What ``neuros reproduce headdirection`` makes of runs; no project is started."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.reproduce import headdirection, running
from benchmarks.reproduce.experiment import Entry, Experiment
from benchmarks.reproduce.headdirection import KIND, LEARNING, PARTS, SERIES, TRAINING, WAYS
from benchmarks.reproduce.kinds import WEIGHTS, Reading
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.tables import Table
from neuros.api.run_record import FORMAT
from neuros.cli.main import main
from neuros.errors import UsageError


def run_folder(folder: Path, simulated_s: float) -> Path:
    folder.mkdir(parents=True)
    record = {"format": FORMAT, "backend": "process", "sim_s": simulated_s, "wall_s": 2.0}
    (folder / "run.json").write_text(json.dumps({**record, "connections": []}))
    return folder


def prediction(
    folder: Path,
    name: str,
    alone: float,
    corrected: float,
    s: float = 60.0,
    learnt: float | None = None,
) -> Reading:
    """A run in which the errors of the rings are so many degrees RMS; vision has none."""
    run = run_folder(folder / name, s)
    (run / "visualiser").mkdir()
    if learnt is not None:
        (run / "snn").mkdir()
        (run / "snn/results.json").write_text(json.dumps({"learnt_bias_rad_s": learnt}))
    sizes = {"uncorrected": alone, "vision": 0.0, "corrected": corrected}
    told = {
        series: {"samples": 2, "rms_deg": size, "max_deg": 2 * size}
        for series, size in sizes.items()
    }
    (run / "visualiser/correction.json").write_text(json.dumps(told))
    header = "stamp_ns,truth_rad,uncorrected_rad,vision_rad,corrected_rad\n"
    lines = "20000000,0.5,1.5,,0.5\n40000000,0.5,1.5,0.5,0.5\n"
    (run / "visualiser/correction.csv").write_text(header + lines)
    return headdirection.read(run, Entry(name, 1, 0.0, 0.0))


def training(folder: Path, places: tuple[float, float] = (1.7, 1.8)) -> Reading:
    """A training run; the errors at held-out places of the network and the nearest neighbour."""
    run = run_folder(folder / TRAINING, 240.0)
    (run / "trainer").mkdir()
    errors = {"network": 3.0, "nearest_neighbour": 4.0, "linear_regression": None}
    at_places = {**errors, "network": places[0], "nearest_neighbour": places[1]}
    told = {"training_s": 53.0, "views": {"learnt": 1474}}
    for held, sizes in (("headings", errors), ("places", at_places)):
        told[f"held_out_{held}"] = {name: {"rms_deg": size} for name, size in sizes.items()}
    (run / "trainer/training.json").write_text(json.dumps(told))
    return headdirection.read(run, Entry(TRAINING, 1, 0.0, 0.0))


def table(sections: list[Section], name: str) -> Table:
    return next(each.table for each in sections if each.table and each.table.name == name)


def verdicts(sections: list[Section]) -> list[str]:
    """The last column of the table of what is wanted."""
    return [row[-1] for row in table(sections, "acceptance").rows]


@pytest.fixture
def good(tmp_path: Path) -> dict[str, list[Reading]]:
    runs = {name: (205.9 if bias else 1.8, 1.7) for name, (_, bias) in WAYS.items()}
    found = {
        name: [prediction(tmp_path, name, *sizes, learnt=0.092 if name in LEARNING else None)]
        for name, sizes in runs.items()
    }
    return {TRAINING: [training(tmp_path)], **found}


def test_every_part_has_a_row_and_what_was_published_stands_below(good, tmp_path):
    sections = [*headdirection.show(good, tmp_path)]
    correction = table(sections, "correction")
    titles = [row[0] for row in correction.rows]
    assert titles[:7] == [PARTS[name] for name in WAYS]
    assert titles[7:] == ["published, NeuROS 1.0", "published, Stentiford et al. 2022"]
    alone, corrected = (f"{SERIES[name]}: RMS, deg" for name in ("uncorrected", "corrected"))
    columns = [correction.headers.index(each) for each in (alone, corrected)]
    assert [[row[column] for column in columns] for row in correction.rows[6:]] == [
        ["205.90", "1.70"],
        ["5.40", "–"],
        ["–", "5.20"],
    ]
    learnt = [row[-1] for row in correction.rows]
    assert learnt == ["–"] * 5 + ["0.0920"] * 2 + ["–"] * 2
    assert table(sections, "training").rows[0][2:5] == ["1474", "53", "3.00"]
    pictures = [picture for section in sections for picture in section.figures]
    assert [each.name for each in pictures] == ["correction_error.png", "correction_rms.png"]
    assert all(each.read_bytes().startswith(b"\x89PNG") for each in pictures)


def test_what_is_wanted_is_judged_by_every_run(good, tmp_path):
    assert verdicts([*headdirection.show(good, tmp_path)]) == [
        "yes (5 of 5)",
        "yes (5 of 5)",
        "yes (5 of 5)",
        "yes (2 of 2)",
        "yes (2 of 2)",
        "yes (1 of 1)",
        "yes (1 of 1)",
        "yes (1 of 1)",
    ]


def test_one_run_that_has_it_not_is_counted(good, tmp_path):
    good["left_biased"].append(prediction(tmp_path / "2", "left_biased", 59.0, 7.6))
    good["right"] = [prediction(tmp_path / "2", "right", 1.4, 1.8)]
    good[TRAINING] = [training(tmp_path / "2", places=(1.8, 1.7))]
    good["right_learning"] = [
        prediction(tmp_path / "2", "right_learning", 205.9, 1.7, learnt=0.1099)
    ]
    good["left_learning"] = [prediction(tmp_path / "2", "left_learning", 205.9, 1.7, learnt=0.1101)]
    assert verdicts([*headdirection.show(good, tmp_path)])[:7] == [
        "no (5 of 6)",
        "no (5 of 6)",
        "no (5 of 6)",
        "no (1 of 2)",
        "no (1 of 2)",
        "yes (1 of 1)",
        "no (0 of 1)",
    ]


def test_what_was_not_run_is_not_judged_and_shorter_runs_are_named(tmp_path):
    runs = {"left_biased": [prediction(tmp_path, "left_biased", 3.0, 1.0, s=2.0)]}
    sections = [*headdirection.show(runs, tmp_path)]
    assert verdicts(sections) == ["no (0 of 1)", "yes (1 of 1)", "yes (1 of 1)", *["–"] * 5]
    assert "Some runs here were shorter" in sections[-1].text[0]


# ------------------------------------------------------------------ weights


def test_each_repetition_trains_before_it_predicts(tmp_path, monkeypatch):
    made: list[str] = []
    kind = replace(KIND, run=lambda name, *_: made.append(name), read=lambda *_: None)
    monkeypatch.setattr(running, "load_before", lambda: 0.0)
    experiment = Experiment.begin(tmp_path / "new", "headdirection", 1.0)
    assert running.run_all(experiment, kind, [TRAINING, "left", "right"], 2, "process", print)
    assert made == [TRAINING, "left", "right", TRAINING, "right", "left"]


def weights(experiment: Path, number: int) -> Path:
    file = experiment / f"runs/{TRAINING}-{number}/trainer/{WEIGHTS}"
    file.parent.mkdir(parents=True)
    file.touch()
    return file


def test_the_training_run_of_the_same_seed_gives_the_weights_unless_they_were_given(tmp_path):
    with pytest.raises(UsageError, match="has no weights: run the part training, or give"):
        headdirection.run("left", tmp_path / "runs/left-1", 1.0, "process")
    weights(tmp_path, 10)
    second, third = (weights(tmp_path, number) for number in (2, 3))
    assert headdirection._weights(tmp_path, 3) == third
    assert headdirection._weights(tmp_path, 1) == second, "without one, those of the first"
    (tmp_path / WEIGHTS).touch()
    assert headdirection._weights(tmp_path, 3) == tmp_path / WEIGHTS


@pytest.mark.parametrize(
    ("experiment", "file", "reason"),
    [
        ("tick", __file__, "--weights: tick takes none"),
        ("headdirection", "nowhere.npz", "--weights nowhere.npz: there is no such file"),
    ],
)
def test_weights_that_do_not_fit_are_refused_before_anything_is_made(
    tmp_path, capsys, experiment, file, reason
):
    folder = tmp_path / "new"
    assert main(["reproduce", experiment, "--weights", file, "-o", str(folder)]) == 2
    assert capsys.readouterr().err.startswith(f"neuros: {reason}")
    assert not folder.exists()
