"""Sessions in virtual time: every back end does the same at the same times, whatever the load."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from std_msgs.msg import Float64

import neuros
from neuros.api.session import Session
from neuros.errors import RunError

DEADLINE_S = 120.0
FLOAT = "std_msgs/msg/Float64"
ACCEPTANCE = pytest.mark.acceptance
BACK_ENDS = ["in-process", "process", pytest.param("docker", marks=ACCEPTANCE)]
# Each packet has the virtual time of the hook that sends it.
PLUGINS = {
    "driver": """
from neuros.hooks import Optional, neuros_function
from neuros.time import to_seconds

@neuros_function(inputs=Optional("more"), outputs="sum")
def drive(node, more):
    sum = node.make_packet("sum")
    sum.data = to_seconds(node.now()) + (0.0 if more is None else more.data)
    return sum
""",
    "worker": """
from neuros.hooks import neuros_function
from neuros.time import to_seconds

@neuros_function(inputs="sum", outputs="done")
def work(node, sum):
    if sum.data >= 9000.0:
        node.shutdown("it was told to")
    done = node.make_packet("done")
    done.data = to_seconds(node.now())
    return done
""",
    "clerk": """
from neuros.hooks import neuros_function, neuros_tick

@neuros_tick(seconds=0.01, outputs="beat")
def tick(node):
    return node.make_packet("beat")

@neuros_function(inputs="done")
def file(node, done):
    pass
""",
}


def wire(source: str, target: str, **more: Any) -> dict[str, Any]:
    (a, output), (b, name) = source.split("."), target.split(".")
    ends = {"source_node": a, "source_output": output}
    return {**ends, "destination_node": b, "destination_input": name, **more}


def described(folder: Path) -> neuros.Project:
    """Three nodes in a ring that loses packets; the driver starts unasked, and for 5 ms."""

    def node(name: str, inputs: str, output: str, **more: Any) -> dict[str, Any]:
        (folder / f"{name}.py").write_text(PLUGINS[name])
        ports = [{"name": each, "type": FLOAT} for each in inputs.split()]
        about = {"name": name, "container": "neuros_python", "plugin": f"{name}.py"}
        return {**about, "inputs": ports, "outputs": [{"name": output, "type": FLOAT}], **more}

    nodes = [
        node("driver", "more", "sum", durations={"drive": 0.005}, environment={"SEED": "3"}),
        node("worker", "sum", "done", durations={"work": {"normal": [0.012, 0.004]}}),
        node("clerk", "done", "beat"),
    ]
    connections = [
        wire("driver.sum", "worker.sum", delay={"uniform": [0.001, 0.02]}, loss=0.2),
        wire("worker.done", "clerk.done", discard_limit=0, delay={"samples": [0.001, 0.04]}),
    ]
    file = folder / "project.json"
    content = {"time": "virtual", "nodes": nodes, "connections": connections}
    file.write_text(json.dumps(content))
    return neuros.Project.from_file(file)


def steps(s: Session) -> None:
    s.step(7, timeout_s=DEADLINE_S)


def sends_and_steps(s: Session) -> None:
    for count in (1, 3, 2):
        for _ in range(count):
            s.send("driver.more", Float64(data=1.0))
        s.step(timeout_s=DEADLINE_S)


def runs_freely_in_between(s: Session) -> None:
    s.step(2, timeout_s=DEADLINE_S)
    s.run(duration_s=0.2)
    sends_and_steps(s)
    s.run(duration_s=0.05)


def steps_until_a_packet_comes(s: Session) -> None:
    s.step(until=lambda s: s["worker.done"].count >= 3, timeout_s=DEADLINE_S)


def is_ended_by_a_plugin(s: Session) -> None:
    s.step(2, timeout_s=DEADLINE_S)
    is_running = True
    while is_running:  # a packet may be lost on its way to the node that ends the run
        s.send("driver.more", Float64(data=9000.0))
        is_running = s.step(timeout_s=DEADLINE_S)


PROGRAMS = [
    steps,
    sends_and_steps,
    runs_freely_in_between,
    steps_until_a_packet_comes,
    is_ended_by_a_plugin,
]


def what_happens(
    folder: Path, backend: str, program: Callable[[Session], None]
) -> tuple[list[float], Any, Any, Any, str]:
    """Times of packets, what became of them, figures of hooks, the last time, and how it ended."""
    project = described(folder)
    with project.session(backend=backend, digests=True, output=folder / backend) as s:
        probe = s.probe("worker.done")
        program(s)
    run = s.close()
    times = [packet.data for packet in probe.packets]
    hooks = {name: node["hooks"] for name, node in run.nodes.items()}
    return times, run.connections, hooks, run.record["virtual_s"], run.reason


@pytest.mark.parametrize("backend", BACK_ENDS)
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.__name__)
def test_the_same_packets_are_sent_and_lost_at_the_same_times_as_in_this_process(
    program: Callable[[Session], None], backend: str, tmp_path: Path
) -> None:
    expected = what_happens(tmp_path, "local", program)
    assert what_happens(tmp_path, backend, program) == expected


@pytest.mark.parametrize("backend", ["local", *BACK_ENDS])
def test_a_round_begins_when_the_last_node_has_come_to_rest(backend: str, tmp_path: Path) -> None:
    with described(tmp_path).session(backend=backend, output=tmp_path / backend) as s:
        assert s["driver.sum"].packet is None
        s.step(timeout_s=DEADLINE_S)
        assert s["driver.sum"].packet.data == 0.0
        s.run(duration_s=1.0)  # freely, so hooks started until then, and not later
        last_s = s["driver.sum"].packet.data
        assert 1.0 < last_s < 1.1
        s.step(timeout_s=DEADLINE_S)
        assert s["driver.sum"].packet.data > last_s


def test_between_processes_it_is_forked_where_it_stands(tmp_path: Path) -> None:
    project = described(tmp_path)
    with project.session(backend="process", forkable=True, output=tmp_path / "a") as s:
        runs_freely_in_between(s)
        with s.fork() as other:
            for each in (s, other):
                sends_and_steps(each)
            assert other["worker.done"].packet == s["worker.done"].packet
            assert other["driver.sum"].count == s["driver.sum"].count


def test_between_processes_a_reset_begins_at_time_0_with_the_same_draws(tmp_path: Path) -> None:
    episodes = []
    with described(tmp_path).session(backend="process", output=tmp_path / "run") as s:
        for seed in (3, 4, 3):
            s.reset(seed=seed)
            runs_freely_in_between(s)
            episodes.append((s["worker.done"].count, s["worker.done"].packet.data))
    assert episodes[0] == episodes[2] != episodes[1]


def test_a_failure_in_a_round_ends_the_session_by_name(tmp_path: Path) -> None:
    project = described(tmp_path)
    broken = PLUGINS["clerk"].replace("pass", "raise ValueError('no more room')")
    (tmp_path / "clerk.py").write_text(broken)
    with project.session(backend="process", output=tmp_path / "run") as s:
        with pytest.raises(RunError, match=r"node 'clerk' failed.*no more room"):
            s.step(until=lambda s: False, timeout_s=DEADLINE_S)
        assert not s.is_running
