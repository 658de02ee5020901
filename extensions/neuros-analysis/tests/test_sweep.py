"""`neuros sweep` and `neuros.sweep`: real runs, one table."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from api_projects import COUNTER, ENDLESS, dice

import neuros
from neuros.cli.main import main
from neuros.errors import ProjectError, UsageError

# Whoever runs these tests in the background has them, and all that they start, ignore Ctrl+C.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from neuros.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
FACES = "nodes.thrower.environment.FACES"
EYES = "thrower.eyes -> counter.eyes"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def rows_of(folder: str) -> list[dict[str, str]]:
    with open(Path(folder, "sweep.csv"), newline="") as file:
        return list(csv.DictReader(file))


def test_a_sweep_is_a_table_whatever_becomes_of_its_runs_and_can_be_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dice(tmp_path, COUNTER.replace("== 13", "> 6"))
    arguments = ["sweep", "dice", "--backend", "in-process", "-o", "table", "--jobs", "2"]
    assert main([*arguments, "--set", f"{FACES}=1", "--seeds", "1"]) == 0
    first = rows_of("table")
    assert first[0]["counter.sum"] == "10"
    assert main([*arguments, "--set", f"{FACES}=1,999999999", "--seeds", "1"]) == 1
    rows = rows_of("table")
    assert rows[0] == first[0], "it was not run again"
    assert [(row["FACES"], row["seed"], row["exit_code"]) for row in rows] == [
        ("1", "1", "0"),
        ("999999999", "1", "1"),
    ]
    assert "thirteen eyes" in rows[1]["reason"]
    sent, consumed = (int(rows[0][f"{EYES}: {what}"]) for what in ("sent", "consumed"))
    assert sent - consumed in (0, 1)  # the last one may not be read
    assert float(rows[0][f"{EYES}: consumed / %"]) == pytest.approx(100 * consumed / sent)
    said = capsys.readouterr().out
    assert "[1/1] FACES=1, seed=1: counter ended the project: ten were thrown" in said
    assert "[2/2] FACES=999999999, seed=1: node 'counter' failed" in said
    assert said.endswith(f"\n{tmp_path}/table/sweep.csv\n")
    again = [*arguments, "--set", f"{FACES}=1,999999999", "--seeds", "1", "--format", "json"]
    assert main(again) == 1
    made = json.loads(capsys.readouterr().out)
    assert made["folder"] == f"{tmp_path}/table"
    assert [row["exit_code"] for row in made["rows"]] == [0, 1]


def test_an_optimiser_asks_for_points_and_is_told_their_rows(tmp_path: Path) -> None:
    project = neuros.Project.from_file(dice(tmp_path, COUNTER.replace("== 13", "> 6")))
    asked = [{FACES: "1"}, {FACES: "999999999"}, {FACES: "1"}]
    runs = neuros.sweep(project, points=asked, backend="in-process", output="first")
    assert [(row["FACES"], row["exit_code"]) for row in runs.rows] == [
        ("1", 0),
        ("999999999", 1),
        ("1", 0),
    ]
    assert [row.get("repeat") for row in runs.rows] == [None, None, 2]
    again = neuros.sweep(project, points=asked[:1], backend="in-process", output="first")
    assert again.rows == runs.rows[:1], "it was not run again"


def test_each_run_begins_with_what_is_restored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plugin = """
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise()
def begin(node):
    runs = [0]
    node.keep("runs", lambda: runs, lambda kept: runs.__setitem__(slice(None), kept))
    runs[0] += 1
    node.set_result("runs", runs[0])

@neuros_function(inputs="eyes")
def end(node, eyes):
    node.shutdown("seen")
"""
    project = neuros.Project.from_file(dice(tmp_path, plugin))
    first = project.run(backend="in-process", output="first", check=True)
    seeds = {"seeds": (1, 2), "backend": "in-process", "output": "table"}
    made = neuros.sweep(project, restore={"counter.runs": first}, **seeds)
    assert [row["counter.runs"] for row in made.rows] == [2, 2]
    with pytest.raises(UsageError, match=r"a sweep that is not this one .its restore differs"):
        neuros.sweep(project, **seeds)
    arguments = ["sweep", "dice", "--backend", "in-process", "-o", "other"]
    assert main([*arguments, "--restore", "counter.runs=table"]) == 2
    assert not Path("other").exists()
    assert main([*arguments, "--restore", "counter.runs=first"]) == 0
    capsys.readouterr()


def test_points_have_the_same_paths(tmp_path: Path) -> None:
    project = neuros.Project.from_file(dice(tmp_path, COUNTER))
    with pytest.raises(UsageError, match="points: number 2 has other paths than the first one"):
        neuros.sweep(project, points=[{FACES: 1}, {}], backend="in-process")


def test_from_python_it_is_a_frame(tmp_path: Path) -> None:
    seeds = np.array([5])
    made = neuros.sweep(dice(tmp_path), set={FACES: [1]}, seeds=seeds, backend="in-process")
    frame = made.frame()
    assert frame.loc[0, ["FACES", "seed", "counter.sum"]].to_list() == [1, 5, 10]
    assert [run.exit_code for run in made.runs()] == [0]


def test_a_value_that_is_not_valid_is_said_before_anything_is_run(tmp_path: Path) -> None:
    dice(tmp_path)
    limit = "connections.thrower.eyes.counter.eyes.discard_limit"
    with pytest.raises(ProjectError) as caught:
        neuros.sweep("dice", set={limit: [0, -1, "x"]}, output="table")
    assert len(caught.value.problems) == 2
    assert not Path("table").exists()


def test_the_folder_of_another_sweep_is_refused(tmp_path: Path) -> None:
    project = dice(tmp_path)
    Path("table").mkdir()
    Path("table/sweep.json").write_text(json.dumps({"project": "another"}))
    with pytest.raises(UsageError, match="holds a sweep that is not this one"):
        neuros.sweep(project, output="table")
    Path("full").mkdir()
    Path("full/mine.txt").write_text("")
    with pytest.raises(UsageError, match="is neither empty nor a sweep"):
        neuros.sweep(project, output="full")


@pytest.mark.parametrize("content", ["[]", "5", "{", "\udcff"])
def test_a_folder_whose_plan_is_damaged_is_refused(tmp_path: Path, content: str) -> None:
    project = dice(tmp_path)
    Path("table").mkdir()
    Path("table/sweep.json").write_text(content, "utf-8", "surrogateescape")
    with pytest.raises(UsageError, match=r"sweep\.json is broken.* name another one with -o"):
        neuros.sweep(project, output="table")


def test_a_plan_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    project = dice(tmp_path)
    Path("table").mkdir()
    os.mkfifo("table/sweep.json")
    with pytest.raises(UsageError, match="it is not an ordinary file"):
        neuros.sweep(project, output="table")


def test_a_duration_that_is_refused_leaves_no_folder(tmp_path: Path) -> None:
    project = dice(tmp_path)
    with pytest.raises(UsageError, match="--duration inf: give seconds"):
        neuros.sweep(project, duration="inf", output="table")
    with pytest.raises(ProjectError, match="exactly one node that owns time: none"):
        neuros.sweep(project, duration="1sim", output="table")
    assert not Path("table").exists()
    assert neuros.sweep(project, duration=60, backend="in-process", output="table").rows
    with pytest.raises(UsageError, match=r"is not this one \(its duration differs\): name another"):
        neuros.sweep(project, duration=61, backend="in-process", output="table")


def test_a_back_end_that_is_refused_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = dice(tmp_path)
    sentence = "back end 'nonsense': choose one of auto, docker, process"
    with pytest.raises(UsageError, match=sentence):
        neuros.sweep(project, backend="nonsense", output="table")
    for command in (["launch", "dice"], ["sweep", "dice", "-o", "table"]):
        assert main([*command, "--backend", "nonsense"]) == 2
        assert sentence in capsys.readouterr().err
    assert not Path("table").exists()


def test_a_folder_is_that_of_one_sweep_at_a_time(tmp_path: Path) -> None:
    project = dice(tmp_path)

    def meanwhile(*_: Any) -> None:
        with pytest.raises(UsageError, match="a sweep goes on there"):
            neuros.sweep(project, backend="in-process", output="table")

    neuros.sweep(project, backend="in-process", output="table", on_row=meanwhile)
    assert not Path("table/.sweep.lock").exists()


def test_ctrl_c_keeps_what_is_done_and_what_was_cut_off_is_run_again(tmp_path: Path) -> None:
    endless_with_two = ENDLESS.replace("if len(seen) == 0", "import os\n    if seen[-1] == 1")
    dice(tmp_path, endless_with_two)
    arguments = ["sweep", "dice", "--set", f"{FACES}=1,-1", "--backend", "in-process", "-o", "t"]
    thrower = (tmp_path / "dice/thrower.py").read_text()
    (tmp_path / "dice/thrower.py").write_text(
        thrower.replace(
            "randint(1,",
            'choice([2]) if os.environ["FACES"] == "-1" else node.get_user_data().randint(1,',
        )
    )
    output = _interrupted_after("[1/2]", arguments, Path("t"))
    assert "[1/2] FACES=1: counter ended the project" in output
    assert [row["FACES"] for row in rows_of("t")] == ["1"]
    (tmp_path / "dice/counter.py").write_text(COUNTER)
    assert main(arguments) == 0
    assert [row["FACES"] for row in rows_of("t")] == ["1", "-1"]
    assert len([*Path("t").glob("*.unfinished-1")]) == 1


def _interrupted_after(text: str, arguments: list[str], folder: Path) -> str:
    """What a sweep prints that gets SIGINT when the run after ``text`` is under way."""
    process: Any = subprocess.Popen(
        [sys.executable, "-u", "-c", PROGRAM, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    killer = threading.Timer(60.0, process.kill)
    killer.start()
    lines = []
    with process:
        for line in process.stdout:
            lines.append(line)
            if text in line:
                while len([*folder.glob("*/project.json")]) < 2:
                    os.sched_yield()
                process.send_signal(signal.SIGINT)
    killer.cancel()
    assert process.returncode == 130, lines
    return "".join(lines)
