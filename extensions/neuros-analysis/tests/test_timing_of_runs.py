"""``neuros timing`` of real runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, launch, start
from neuros_analysis.timing import measure

from neuros.cli.main import main
from neuros.distribution import WORKSPACE
from neuros.project.load import load_project

SENSOR = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=0.02, outputs="number")
def measure(node):
    return node.make_packet("number")
"""
BRAIN = """
import time
from neuros.hooks import neuros_function

@neuros_function(inputs="number", outputs="number")
def estimate(node, number):
    time.sleep(0.004)
    return number
"""
MOTOR = """
from neuros.hooks import neuros_function

@neuros_function(inputs="number")
def move(node, number, count=[0]):
    count[0] += 1
    if count[0] == 40:
        node.shutdown("forty")
"""
TO_BRAIN, TO_MOTOR = "sensor.number -> brain.number", "brain.number -> motor.number"
VIRTUAL = ("--backend", "in-process", "--time", "virtual")
PORT = [{"name": "number", "type": "std_msgs/msg/Int32"}]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A tick of 20 ms, a hook of at least 4 ms, and a third one that ends the run."""
    folder = tmp_path / "project"
    folder.mkdir()
    plugins = {"sensor": SENSOR, "brain": BRAIN, "motor": MOTOR}
    for name, text in plugins.items():
        (folder / f"{name}.py").write_text(text)
    ports = (("sensor", [], PORT), ("brain", PORT, PORT), ("motor", PORT, []))
    nodes = [
        {"name": name, "container": "neuros_python", "plugin": f"{name}.py", "inputs": inputs,
         "outputs": outputs}
        for name, inputs, outputs in ports
    ]  # fmt: skip
    connections = [
        {"source_node": source, "source_output": "number", "destination_node": destination,
         "destination_input": "number", "discard_limit": 0}
        for source, destination in (("sensor", "brain"), ("brain", "motor"))
    ]  # fmt: skip
    (folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": connections}))
    return folder


@pytest.mark.parametrize("back_end", BACKENDS)
def test_of_a_run_in_real_time_all_hooks_and_connections_are_measured(
    tmp_path: Path, project: Path, back_end: str
) -> None:
    """The file is one that the project accepts in virtual time."""
    run, file = tmp_path / "run", tmp_path / "timing.json"
    finished = launch(project, "--backend", back_end, "-m", "-o", str(run), cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    timing = measure(run)
    assert {name: len(each.values_s) for name, each in timing.hooks.items()} == {
        f"{node}.{hook}": figures["executions"]
        for node, each in finished.record["nodes"].items()
        for hook, figures in each["hooks"].items()
    }
    assert min(timing.hooks["brain.estimate"].values_s) >= 0.004
    assert not timing.missing
    for name in (TO_BRAIN, TO_MOTOR):
        delays, latencies = timing.connections[name], timing.latencies_s[name]
        assert len(latencies) == finished.connection(name)["consumed"]
        if delays.of == "packets":
            assert len(delays.values_s) <= len(latencies)
            assert set(delays.values_s) <= {max(1e-6, each) for each in latencies}
    (where,) = timing.provenance["runs"]
    assert where["run_id"] == finished.record["run_id"]
    assert where["back_end"] == back_end
    assert where["processor"]
    assert where["load"]["cpu_percent_mean"] >= 0

    assert main(["timing", str(run), "-o", str(file), "--plot", str(tmp_path / "t.png")]) == 0
    loaded = load_project(project, workspace=WORKSPACE, time="virtual", timing=file).project
    assert {*loaded.node("brain").durations} == {"estimate"}
    assert all(each.delay.kind == "samples" for each in loaded.connections)


def test_a_run_in_virtual_time_shows_what_was_declared(
    tmp_path: Path, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All nodes share a process, and still none keeps another one busy."""
    content = json.loads((project / "project.json").read_text())
    content["nodes"][1]["durations"] = {"estimate": 0.007}
    for connection, delay in zip(content["connections"], (0.003, 0.0015), strict=True):
        connection["delay"] = delay
    (project / "project.json").write_text(json.dumps(content))
    run = tmp_path / "run"
    finished = launch(project, *VIRTUAL, "-o", str(run), cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    timing = measure(run)
    assert {*timing.hooks["brain.estimate"].values_s} == {0.007}
    for name, delay_s in ((TO_BRAIN, 0.003), (TO_MOTOR, 0.0015)):
        assert timing.connections[name].values_s == pytest.approx(
            [delay_s] * finished.connection(name)["consumed"]
        )
    assert main(["timing", str(run), "-o", str(tmp_path / "timing.json")]) == 2
    assert "declared and not measured: name a run in real time" in capsys.readouterr().err


def test_what_was_measured_is_repeated_in_virtual_time(
    tmp_path: Path, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two repetitions are equal, and their times are drawn from the measured ones."""
    measured, file = tmp_path / "measured", tmp_path / "timing.json"
    assert launch(project, "-o", str(measured), cwd=tmp_path).exit_code == 0
    assert main(["timing", str(measured), "-o", str(file)]) == 0
    repeated = [tmp_path / "repeated", tmp_path / "again"]
    for run in repeated:
        finished = launch(project, *VIRTUAL, "--timing", str(file), "-o", str(run), cwd=tmp_path)
        assert finished.exit_code == 0, finished.output
    assert main(["verify", *map(str, repeated)]) == 0
    samples = json.loads(file.read_text())["hooks"]["brain.estimate"]["samples"]
    drawn = measure(repeated[0]).hooks["brain.estimate"].values_s
    assert {round(each, 9) for each in drawn} <= {*samples}
    assert main(["timing", str(measured), str(repeated[0])]) == 0
    out = capsys.readouterr().out
    for name in ("brain.estimate", TO_BRAIN, f"{TO_BRAIN}: latency"):
        assert any(line.startswith(f"{name} ") for line in out.splitlines())


def test_parts_of_a_run_are_measured_together(tmp_path: Path, project: Path) -> None:
    """Two launchers of one machine share its clock: the difference found is within its error."""
    parts = tmp_path / "parts"
    common = ("-d", "87", "--backend", "process")
    here = ("-n", "sensor", "-o", str(parts / "here"))
    there = ("-n", "brain", "-n", "motor", "-o", str(parts / "there"))
    with start(project, *common, *here, cwd=tmp_path) as one:
        other = launch(project, *common, *there, cwd=tmp_path)
        finished = one.finish()
    assert (finished.exit_code, other.exit_code) == (0, 0), finished.output + other.output
    timing = measure(parts)
    assert {*timing.connections} == {TO_BRAIN, TO_MOTOR}
    clock = timing.provenance["clocks"]["there"]
    assert abs(clock["ahead_s"]) <= clock["error_s"] + 1e-6
    assert len(timing.provenance["runs"]) == 2


def test_a_run_without_packet_log_says_what_to_leave_out(
    tmp_path: Path, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = ("--backend", "process", "--packet-log", "0", "-o", str(run))
    assert launch(project, *options, cwd=tmp_path).exit_code == 0
    assert main(["timing", str(run)]) == 2
    assert "--packet-log 0: run the project again without" in capsys.readouterr().err
