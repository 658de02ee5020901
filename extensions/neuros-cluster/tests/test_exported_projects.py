"""Exported projects, started by Docker's own tools from the exported files alone."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from deadlines import wait_until
from launching import Finished, launch
from needs import require

from containers import connected, require_containers
from neuros.cli.main import main

pytestmark = pytest.mark.acceptance

PLAYER = """
import os
from neuros.hooks import Optional, neuros_finalise, neuros_function, neuros_initialise

@neuros_initialise(outputs=Optional("ball"))
def serve(node):
    return node.make_packet("ball") if node.name == "ann_1" else None

@neuros_function(inputs="ball", outputs="ball")
def hit(node, ball):
    answer = node.make_packet("ball")
    answer.data = ball.data + 1
    if ball.data == int(os.environ["ENOUGH"]):
        node.shutdown("enough")
    if ball.data == int(os.environ["TOO_MANY"]):
        raise RuntimeError("the ball is out")
    return answer

@neuros_finalise()
def leave(node):
    node.set_result("has_left", True)
"""
PLAYERS = ("ann_1", "bob")
NEVER = "-1"
FOUND_S = 120.0  # containers are started, and find each other, on a machine that does other things


def rally(folder: Path, *, enough: str = NEVER, too_many: str = NEVER) -> Path:
    """Two players and a ball: the same packets in every run."""
    folder.mkdir()
    (folder / "player.py").write_text(PLAYER)
    port = [{"name": "ball", "type": "std_msgs/msg/Int32"}]
    variables = {"ENOUGH": enough, "TOO_MANY": too_many}
    nodes = [
        {"name": name, "container": "neuros_python", "plugin": "player.py", "inputs": port,
         "outputs": port, "environment": variables, "resources": {"memory": "512m"}}
        for name in PLAYERS
    ]  # fmt: skip
    connections = [
        {"source_node": a, "source_output": "ball", "destination_node": b,
         "destination_input": "ball", "discard_limit": 0}
        for a, b in (PLAYERS, reversed(PLAYERS))
    ]  # fmt: skip
    (folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": connections}))
    return folder


class Composed:
    """An exported project, in the hands of ``docker-compose``."""

    def __init__(self, project: Path) -> None:
        self.folder = project.with_name(f"{project.name}-exported")
        assert main(["export", "compose", str(project), "-o", str(self.folder)]) == 0
        self.runs = self.folder / "runs" / "trial"

    def __call__(self, *command: str) -> None:
        run(["docker-compose", *command], self.folder)

    def record(self, node: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.runs / node / "run.json").read_text())
        return found

    def wait(self) -> None:
        """Until both containers have ended."""
        names = [f"{self.folder.name}_{name}_1" for name in ("ann-1", "bob")]
        with connected() as engine:
            found = [engine.containers.get(name) for name in names]
            for container in found:
                container.wait(timeout=FOUND_S)

    def finish(self) -> None:
        self("down", "--volumes")
        remove_images(self.folder / "compose.yaml")


def run(command: list[str], folder: Path, **environment: str) -> str:
    """Run a tool of Docker's, which must succeed; returns what it has written."""
    own = {"RUN": "trial", "DOCKER_BUILDKIT": "0", "COMPOSE_DOCKER_CLI_BUILD": "0"}
    whole = {**os.environ, **own, **environment}
    done = subprocess.run(
        command, cwd=folder, env=whole, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
    return done.stdout


def remove_images(file: Path) -> None:
    """What was built for an export; what it was built on stays."""
    with connected() as engine:
        for service in yaml.safe_load(file.read_text())["services"].values():
            if engine.images.list(service["image"]):
                engine.images.remove(service["image"])


@pytest.fixture
def reference(tmp_path: Path) -> Finished:
    """A run of 100 balls by ``neuros launch``."""
    folder = tmp_path / "reference"
    folder.mkdir()
    finished = launch(rally(tmp_path / "rally", enough="100"), cwd=folder)
    assert finished.exit_code == 0, finished.output
    return finished


@pytest.fixture
def composed(tmp_path: Path) -> Iterator[list[Composed]]:
    """Those that a test starts; they are removed in the end."""
    require_containers()
    require("docker-compose")
    started: list[Composed] = []
    yield started
    for each in started:
        each.finish()


def start(project: Path, composed: list[Composed]) -> Composed:
    composed.append(Composed(project))
    composed[-1]("up", "--build", "--detach")
    return composed[-1]


def assert_identical(a: Path, b: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["verify", str(a), str(b)]) == 0
    said = capsys.readouterr().out
    count = re.fullmatch(r"identical: (\d+) packets\n", said)
    assert count, said
    assert int(count[1]) > 100


def test_a_run_by_compose_carries_the_packets_of_a_local_one(
    reference: Finished,
    composed: list[Composed],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    project = start(tmp_path / "rally", composed)
    project.wait()
    assert reference.run_folder is not None
    assert_identical(reference.run_folder, project.runs, capsys)
    for node in PLAYERS:
        record = project.record(node)
        assert record["exit_code"] == 0
        assert [c["lost"] for c in record["connections"]] == [0, 0]


def test_a_node_that_fails_ends_the_containers_of_all(
    composed: list[Composed], tmp_path: Path
) -> None:
    project = start(rally(tmp_path / "rally", too_many="7"), composed)
    project.wait()
    assert [project.record(node)["exit_code"] for node in PLAYERS] == [1, 1]
    reasons = "".join(project.record(node)["reason"] for node in PLAYERS)
    assert "the ball is out" in reasons
    assert "the project ended elsewhere" in reasons


def test_a_container_that_is_killed_is_missed_by_the_others(
    composed: list[Composed], tmp_path: Path
) -> None:
    project = start(rally(tmp_path / "rally"), composed)
    wait_until(lambda: has_played(project, "bob"), FOUND_S)
    project("kill", "ann-1")
    project.wait()
    record = project.record("bob")
    assert (record["exit_code"], record["nodes"]["bob"]["results"]) == (1, {"has_left": True})
    assert "node 'ann_1' on" in record["reason"]


def test_stopping_one_container_stops_all_and_their_finalise_hooks_run(
    composed: list[Composed], tmp_path: Path
) -> None:
    project = start(rally(tmp_path / "rally"), composed)
    wait_until(lambda: all(has_played(project, node) for node in PLAYERS), FOUND_S)
    project("stop", "--timeout", "30", "bob")
    project.wait()
    for node in PLAYERS:
        record = project.record(node)
        assert record["exit_code"] == 143
        assert record["nodes"][node]["results"] == {"has_left": True}


def has_played(project: Composed, node: str) -> bool:
    """Whether packets have come, as the list shows that a node writes once per second."""
    lists = (project.runs / node / node / "packets").glob("*.taken")
    return any(each.stat().st_size for each in lists)
