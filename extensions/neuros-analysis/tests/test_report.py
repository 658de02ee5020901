"""Reports of real runs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, launch
from neuros_analysis.charts import time_budget_figure
from neuros_analysis.review import open_for_review

from neuros.cli.main import main

FIGURES = {"graph", "time_shares", "swim_lanes", "real_time", "packets", "latency"}


@pytest.mark.parametrize("back_end", BACKENDS)
def test_a_run_of_the_elevator_becomes_a_page(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    finished = launch(
        EXAMPLES / "3_physics_simulation/elevator",
        *("--backend", back_end, "--duration", "2sim", "-o", str(tmp_path / "run")),
        cwd=tmp_path,
    )
    assert finished.exit_code == 0, finished.output
    assert main(["report", str(tmp_path / "run")]) == 0
    assert {path.stem for path in (tmp_path / "run/report").glob("*.png")} == FIGURES
    out = capsys.readouterr().out
    (missing,) = (line for line in out.splitlines() if line.startswith("missing:"))
    assert "without -m" in missing
    page = (tmp_path / "run/report/report.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == len(FIGURES)


SLOW_TO_BEGIN = """
import time
from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise

@neuros_initialise()
def prepare(node):
    time.sleep(0.5)

@neuros_function(inputs="number")
def use(node, number):
    time.sleep(0.02)
    if number.data == 30:
        node.shutdown("thirty")

@neuros_finalise()
def tidy(node):
    time.sleep(0.5)
"""
SENDER = """
import time
from neuros.hooks import neuros_function

@neuros_function(outputs="number")
def send(node, count=[0]):
    time.sleep(0.005)
    count[0] += 1
    number = node.make_packet("number")
    number.data = count[0]
    return number
"""
INT = "std_msgs/msg/Int32"


def pipeline(folder: Path) -> Path:
    """A sender of 5 ms, and a receiver of 20 ms that is slow to begin and to end."""
    (folder / "sender.py").write_text(SENDER)
    (folder / "receiver.py").write_text(SLOW_TO_BEGIN)
    ends = {"source_node": "sender", "source_output": "number",
            "destination_node": "receiver", "destination_input": "number"}  # fmt: skip
    nodes = [
        {"name": "sender", "plugin": "sender.py", "outputs": [{"name": "number", "type": INT}]},
        {"name": "receiver", "plugin": "receiver.py", "inputs": [{"name": "number", "type": INT}]},
    ]
    project = {
        "nodes": [{"container": "neuros_python", **node} for node in nodes],
        "connections": [{**ends, "discard_limit": 0}],
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


@pytest.mark.parametrize("back_end", BACKENDS)
def test_shares_of_time_are_the_same_on_the_console_in_words_and_in_figures(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    finished = launch(
        pipeline(tmp_path), "--backend", back_end, "-o", str(tmp_path / "run"), cwd=tmp_path
    )
    assert finished.exit_code == 0, finished.output
    rows = (line.split() for line in finished.output.splitlines())
    table = {cells[0]: cells[1:5] for cells in rows if cells and cells[0] in ("sender", "receiver")}
    executing = {name: cells[0] for name, cells in table.items()}
    for cells in table.values():
        assert sum(int(cell.rstrip("%")) for cell in cells) <= 102  # they are rounded
    if back_end == "in-process":  # one thread, which goes on for a while when the end has begun
        books = [node["accounting"]["executing"] for node in finished.record["nodes"].values()]
        assert sum(sum(hooks.values()) for hooks in books) <= finished.record["wall_s"]

    run = open_for_review(tmp_path / "run")
    assert main(["report", str(tmp_path / "run")]) == 0
    words = dict(re.findall(r"(?m)^  (\w+) .*executes (\d+%)", capsys.readouterr().out))
    assert words == executing

    (axes,) = time_budget_figure(run).axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    drawn = {
        name: [f"{bars[row].get_width():.0f}%" for bars in axes.containers]
        for row, name in enumerate(names)
    }
    assert drawn == table
    assert main(["compare", str(tmp_path / "run")]) == 0
    compared = re.findall(r"(\w+): executing / % +([\d.]+)", capsys.readouterr().out)
    assert [name for name, _ in compared] == [*executing]
    for name, share in compared:  # with a digit more
        assert abs(float(share) - int(executing[name].rstrip("%"))) <= 0.5 + 1e-9


def test_a_page_of_virtual_time_has_what_was_declared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, ends = tmp_path / "run", "sender.number.receiver.number"
    finished = launch(
        pipeline(tmp_path),
        *("--backend", "in-process", "--time", "virtual", "-o", str(run)),
        *(
            "--set",
            'nodes.sender.durations={"send": 0.005}',
            "--set",
            f"connections.{ends}.delay=0.04",
        ),
        cwd=tmp_path,
    )
    assert finished.exit_code == 0, finished.output
    assert main(["report", str(run)]) == 0
    page = (run / "report/report.html").read_text("utf-8")
    assert re.search(r"\d\.\d\d s of virtual time", page)
    rows = [re.findall("<td>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", page)]
    assert ["sender.send", "duration of the hook", "0.005"] in rows
    assert ["sender.number -&gt; receiver.number", "delay", "0.04"] in rows

    record = json.loads((run / "run.json").read_text())
    record["expanded_project"]["nodes"][0]["durations"] = 5
    (run / "run.json").write_text(json.dumps(record))
    assert main(["report", str(run)]) == 4
    assert "run.json is broken: $.expanded_project.nodes[0].durations" in capsys.readouterr().err
