"""``neuros verify`` on real runs: the same project twice, across back ends, and changed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import EXAMPLES, Finished, launch

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
        options = ("--backend", "in-process", "-r", "--storage", "sqlite3")
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
