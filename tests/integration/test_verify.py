"""``neuros verify`` on real runs: the same project twice, across back ends, and changed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch
from replaying import replay

from neuros.cli.main import main

PROJECT = EXAMPLES / "3_physics_simulation/elevator"
PLAYER = """
import os, time
from neuros.hooks import Optional, neuros_function, neuros_initialise

@neuros_initialise(outputs=Optional("ball"))
def serve(node):
    return node.make_packet("ball") if node.name == "ann" else None

@neuros_function(inputs="ball", outputs="ball")
def hit(node, ball):
    end_s = time.thread_time() + float(os.environ["STEP_S"])
    while time.thread_time() < end_s:
        pass
    answer = node.make_packet("ball")
    answer.data = ball.data + 1
    if ball.data == 150:
        node.shutdown("enough")
    return answer
"""
STRICT = ("--duration", "2sim")


def run(folder: Path, *arguments: str, project: Path = PROJECT) -> Finished:
    folder.mkdir()
    length = STRICT if project == PROJECT else ()
    finished = launch(project, *length, *arguments, cwd=folder)
    assert finished.exit_code == 0, finished.output
    return finished


@pytest.fixture(scope="module")
def players(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project that gives the same packets in every run: two players and a ball."""
    folder = tmp_path_factory.mktemp("players")
    (folder / "player.py").write_text(PLAYER)
    port = [{"name": "ball", "type": "std_msgs/msg/Int32"}]
    ends = [("ann", "bob"), ("bob", "ann")]
    nodes = [
        {"name": name, "container": "neuros_python", "plugin": "player.py",
         "environment": {"STEP_S": "0"}, "inputs": port, "outputs": port}
        for name, _ in ends
    ]  # fmt: skip
    connections = [
        {"source_node": a, "source_output": "ball", "destination_node": b,
         "destination_input": "ball", "discard_limit": 0}
        for a, b in ends
    ]  # fmt: skip
    (folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": connections}))
    return folder


@pytest.fixture(scope="module")
def rally(players: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("runs") / "rally"
    return run(folder, "--backend", "process", "-r", project=players)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run(tmp_path_factory.mktemp("runs") / "reference", "--backend", "process", "-r")


def verify(a: Finished, b: Finished, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = main(["verify", str(a.run_folder), str(b.run_folder)])
    return code, capsys.readouterr().out


@pytest.mark.parametrize("arguments", [("process",), ("in-process", "--digests")])
def test_a_strict_run_is_repeated_packet_by_packet(
    tmp_path: Path,
    players: Path,
    rally: Finished,
    arguments: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = run(tmp_path / "other", "--backend", *arguments, project=players)
    code, text = verify(rally, other, capsys)
    assert code == 0, text
    assert text.startswith("identical: ")
    digests = [
        [each["digests"]["sent"] for each in finished.record["connections"]]
        for finished in (rally, other)
    ]
    assert digests[0] == digests[1]


def test_another_project_is_told_by_its_first_packet_and_the_field(
    tmp_path: Path, reference: Finished, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = run(tmp_path / "changed", "--set", "nodes.controller.environment.TOUR=3 0", "-r")
    code, text = verify(reference, changed, capsys)
    assert code == 1
    first = "different: controller.target -> elevator.target: packet 1 differs"
    assert f"{first} in data: " in text
    assert changed.run_folder is not None
    (changed.run_folder / "recording.json").write_text("{")
    _code, text = verify(reference, changed, capsys)
    assert "recording.json is damaged" in text
    assert f"{first} (to see in which field, run both with --record)" in text


def test_in_process_without_digests_there_is_nothing_to_compare(
    tmp_path: Path, reference: Finished, capsys: pytest.CaptureFixture[str]
) -> None:
    lossy = "connections.elevator.cabin.controller.cabin.discard_limit=1"
    other = run(tmp_path / "other", "--backend", "in-process", "--set", lossy)
    code, text = verify(reference, other, capsys)
    assert code == 2
    assert "--digests" in text
    assert text.endswith("unknown: there is nothing to compare\n")


@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_in_process_what_was_recorded_is_compared(
    tmp_path: Path,
    players: Path,
    rally: Finished,
    back_end: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    first = run(tmp_path / "first", "--backend", "in-process", "-r", project=players)
    assert {each["digests"] for each in first.record["connections"]} == {None}
    if back_end == "process":
        other = rally
    else:
        options = ("--backend", "in-process", "-r")
        other = run(tmp_path / "second", *options, project=players)
    code, text = verify(first, other, capsys)
    assert code == 0, text
    assert text == f"identical: {sum(c['sent'] for c in first.record['connections'])} packets\n"


@pytest.mark.parametrize(("step_s", "are_kept"), [(0.005, True), (0.0, False)])
def test_in_process_digests_of_a_lossless_project_are_kept_where_they_are_cheap(
    tmp_path: Path, players: Path, step_s: float, are_kept: bool
) -> None:
    """Some 10 us each, of 5 ms or of next to nothing."""
    steps = [f"nodes.{name}.environment.STEP_S={step_s}" for name in ("ann", "bob")]
    options = [option for step in steps for option in ("--set", step)]
    finished = run(tmp_path / "run", "--backend", "in-process", *options, project=players)
    for connection in finished.record["connections"]:
        digests = connection["digests"]
        assert (digests is not None) == are_kept
        assert digests is None or digests["sent_packets"] == connection["sent"]


def test_latencies_are_there_with_and_without_digests(reference: Finished) -> None:
    for connection in reference.record["connections"]:
        latency_ms = connection["latency_ms"]
        assert 0 < latency_ms["p50"] <= latency_ms["p90"] <= latency_ms["p99"] <= latency_ms["max"]
        assert latency_ms["count"] == connection["consumed"]


TICKS = 150


def ticking(folder: Path) -> Path:
    """A node that sends numbers to another one, without loss, and ends the run."""
    (folder / "a.py").write_text(
        "from neuros.hooks import neuros_function\n"
        "@neuros_function(outputs='out')\n"
        "def send(node, count=[0]):\n"
        "    count[0] += 1\n"
        f"    if count[0] == {TICKS}:\n"
        "        node.shutdown('done')\n"
        "    number = node.make_packet('out')\n"
        "    number.data = count[0]\n"
        "    return number\n"
    )
    (folder / "b.py").write_text(
        "from neuros.hooks import neuros_function\n"
        "@neuros_function(inputs='in')\n"
        "def take(node, number):\n"
        "    pass\n"
    )
    number, container = {"type": "std_msgs/msg/Int32"}, {"container": "neuros_python"}
    connection = {"source_node": "a", "source_output": "out", "destination_node": "b"}
    project = {
        "nodes": [
            {**container, "name": "a", "plugin": "a.py", "outputs": [{**number, "name": "out"}]},
            {**container, "name": "b", "plugin": "b.py", "inputs": [{**number, "name": "in"}]},
        ],
        "connections": [{**connection, "destination_input": "in", "discard_limit": 0}],
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


@pytest.mark.parametrize("back_end", BACKENDS)
def test_a_long_run_keeps_the_newest_packets_and_every_command_says_so(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    project, size = ticking(tmp_path), 4096
    for name in ("first", "second"):
        options = ("--digests", "--packet-log", "4k", "-o", str(tmp_path / name))
        finished = launch(project, "--backend", back_end, *options, cwd=tmp_path)
        assert finished.exit_code == 0, finished.output
        (connection,) = json.loads((tmp_path / name / "run.json").read_text())["connections"]
        counts = [connection[key] for key in ("sent", "received", "consumed", "lost")]
        assert counts == [TICKS, TICKS, TICKS, 0]
        lists = list(tmp_path.glob(f"{name}/*/packets/0.*"))
        assert 0 < sum(file.stat().st_size for file in lists) <= size
        assert 0 < connection["latency_ms"]["count"] < TICKS
    first, second = str(tmp_path / "first"), str(tmp_path / "second")
    assert main(["verify", first, second]) == 0
    said = capsys.readouterr().out
    assert "are not kept (--packet-log)" in said
    last = r"^identical: \d+ packets; 1 connection was not compared, or not whole$"
    assert re.search(last, said, re.MULTILINE)
    assert main(["report", first]) == 0
    assert "packets of a.out -> b.in: they are not kept" in capsys.readouterr().out
    assert main(["compare", first, second]) == 0
    assert re.search(rf"sent +{TICKS} +{TICKS}", capsys.readouterr().out)


@pytest.mark.parametrize("back_end", BACKENDS)
def test_without_a_packet_log_the_table_is_right_and_there_is_nothing_to_verify(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--packet-log", "0", "-o", str(tmp_path / "run"))
    finished = launch(ticking(tmp_path), "--backend", back_end, *options, cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    assert not [*tmp_path.glob("run/*/packets")]
    (connection,) = json.loads((tmp_path / "run/run.json").read_text())["connections"]
    assert (connection["sent"], connection["consumed"]) == (TICKS, TICKS)
    assert (connection["latency_ms"], connection["digests"]) == (None, None)
    run = str(tmp_path / "run")
    assert main(["verify", run, run]) == 2
    assert "--packet-log 0" in capsys.readouterr().out
    assert main(["report", run]) == 0
    assert "the run was made with --packet-log 0" in capsys.readouterr().out


def test_a_recorded_run_without_a_packet_log_can_be_replayed(tmp_path: Path) -> None:
    options = ("-r", "--packet-log", "0", "-o", str(tmp_path / "run"))
    finished = launch(ticking(tmp_path), *options, cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    assert {file.name for file in tmp_path.glob("run/*/packets/*")} == {"event_log"}
    replayed = replay(tmp_path / "run", "a")
    assert replayed.returncode == 0, replayed.stderr
    assert f"{TICKS} packets" in replayed.stdout


SERVER = """
from neuros.hooks import neuros_initialise

@neuros_initialise(outputs="ball")
def serve(node):
    return node.make_packet("ball")
"""
CATCHER = """
import os
from neuros.hooks import Optional, neuros_function

@neuros_function(inputs=["ball", "own"] if os.environ["WAITS"] else "ball", outputs=Optional("own"))
def catch(node, *packets):
    node.shutdown("caught")
"""


@pytest.mark.parametrize("arguments", [("process",), ("in-process", "--digests")])
def test_runs_whose_hooks_took_other_packets_are_not_said_to_be_identical(
    tmp_path: Path, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "server.py").write_text(SERVER)
    (tmp_path / "catcher.py").write_text(CATCHER)
    ball, own = ({"name": name, "type": "std_msgs/msg/Int32"} for name in ("ball", "own"))
    nodes = [
        {"name": "ann", "container": "neuros_python", "plugin": "server.py", "outputs": [ball]},
        {"name": "bob", "container": "neuros_python", "plugin": "catcher.py",
         "environment": {"WAITS": ""}, "inputs": [ball, own], "outputs": [own]},
    ]  # fmt: skip
    connections = [
        {"source_node": node, "source_output": port, "destination_node": "bob",
         "destination_input": port}
        for node, port in (("ann", "ball"), ("bob", "own"))
    ]  # fmt: skip
    project = tmp_path / "project.json"
    project.write_text(json.dumps({"nodes": nodes, "connections": connections}))
    options = ("--backend", *arguments)
    first, again = (run(tmp_path / name, *options, project=project) for name in ("a", "b"))
    assert verify(first, again, capsys) == (0, "identical: 1 packet\n")
    waits = ("--set", "nodes.bob.environment.WAITS=yes", "--duration", "1")
    other = run(tmp_path / "c", *options, *waits, project=project)
    code, text = verify(first, other, capsys)
    assert code == 6
    assert text == (
        "note: ann.ball -> bob.ball: hooks took 1 packets in run A, and 0 in run B: this"
        " connection may lose packets\n"
        "sent packets identical: 1 packet; 1 connection was consumed differently\n"
    )
