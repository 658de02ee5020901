"""Runs in virtual time: those that may lose packets are the same in every repetition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from launching import EXAMPLES, launch

import neuros
import neuros.bag
from neuros.api.run_record import PastRun, open_run
from neuros.api.verify import RecordedPackets, compare
from neuros.hooks import neuros_function, neuros_tick

MS = 1_000_000
WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
DURATIONS = 'nodes.snn.durations.integrate={"normal":[0.045,0.005]}'


@neuros_tick(seconds=0.01, outputs="x")
def tick(node: Any) -> Any:
    return node.make_packet("x")


@neuros_function(inputs="x")
def take(node: Any, x: Any) -> None: ...


@neuros_function(inputs="x", outputs="y")
def answer(node: Any, x: Any) -> Any:
    return x


def run(folder: Path, project: str, backend: str = "in-process") -> PastRun:
    finished = launch(
        WHISKEYE / f"{project}.json",
        *("--backend", backend, "--time", "virtual", "-o", str(folder)),
        *("--set", "nodes.robot.environment.DURATION=1", "--set", DURATIONS),
        cwd=folder.parent,
    )
    assert finished.exit_code == 0, finished.output
    return open_run(folder)


@pytest.mark.parametrize("project", ["no_discard_limit", "asynchronous", "tick_60ms"])
def test_a_lossy_run_can_be_repeated(project: str, tmp_path: Path) -> None:
    a, b = (run(tmp_path / name, project) for name in "ab")
    found = compare(a, b, RecordedPackets())
    assert (found.difference, found.remarks, found.not_compared) == (None, (), ())
    assert found.compared > 0
    imu = a.connections["robot.imu -> snn.imu"]
    if project != "tick_60ms":
        assert 20 <= imu["consumed"] < imu["sent"]  # a packet each 20 ms, and a hook takes 45


def test_nodes_in_processes_of_their_own_give_the_same_run(tmp_path: Path) -> None:
    in_process = run(tmp_path / "in_process", "asynchronous")
    apart = run(tmp_path / "apart", "asynchronous", backend="process")
    found = compare(in_process, apart, RecordedPackets())
    assert (found.difference, found.remarks, found.not_compared) == (None, (), ())


def test_a_recording_has_the_times_of_the_experiment_on_every_back_end(tmp_path: Path) -> None:
    number = "std_msgs/msg/Int32"
    a = neuros.Node("a", tick, outputs={"x": number})
    durations = {"answer": 0.002}
    b = neuros.Node("b", answer, inputs={"x": number}, outputs={"y": number}, durations=durations)
    c = neuros.Node("c", take, inputs={"x": number})
    connections = [
        neuros.Connection(a["x"], b["x"], discard_limit=0, delay=0.001),
        neuros.Connection(b["y"], c["x"], discard_limit=0),
    ]
    project = neuros.Project([a, b, c], connections, folder=tmp_path, time="virtual")
    for backend in ("in-process", "process"):
        folder = tmp_path / backend
        project.run(backend=backend, duration=0.1, record=True, output=folder)
        with neuros.bag.open(folder) as bag:
            assert bag.custom["time"] == "virtual"
            sent, answered = bag["a.x"], bag["b.y"]
            assert [*sent.array()["log_time_ns"]] == [*range(10 * MS, 100 * MS, 10 * MS)]
            assert [*answered.array()["publish_time_ns"]] == [*range(13 * MS, 100 * MS, 10 * MS)]
            assert answered.frame().index[0].total_seconds() == 0.013
            assert answered.xarray()["time"].attrs["long_name"] == "virtual time"
            assert answered.xarray()["virtual_time"].dt.microseconds[0] == 13_000


def test_a_ring_that_nothing_starts_is_a_deadlock_between_processes(tmp_path: Path) -> None:
    number = "std_msgs/msg/Int32"
    a, b = (neuros.Node(n, answer, inputs={"x": number}, outputs={"y": number}) for n in "ab")
    connections = [
        neuros.Connection(source["y"], target["x"], discard_limit=0)
        for source, target in ((a, b), (b, a))
    ]
    with pytest.warns(UserWarning, match="nobody starts the loop"):
        ring = neuros.Project([a, b], connections, folder=tmp_path, time="virtual")
    ended = ring.run(backend="process", output=tmp_path / "run")
    assert ended.exit_code == 1
    assert "deadlock: nothing can ever run again: a waits for `x` from b" in ended.reason
