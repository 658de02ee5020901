"""A deployment with a Docker engine as a host: its nodes run in containers there.

The engine is that of this machine; :mod:`network.test_deployment_by_ssh` has one behind ``ssh``.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from back_end_checks import PROJECTS
from deadlines import wait_until
from docker import DockerClient
from launching import Running, killed_in_a_hook, launch, start
from neuros_cluster.remote_engine import AGENT_LABEL

from containers import connected, require_containers

HERE = Path(__file__).parents[3] / "tests/integration"
STREAM = HERE / "network" / "stream"
CONNECTION = "source.image -> sink.image"
ENDLESS = ("--set", "nodes.source.environment.COUNT=0")
UP_S = 120.0  # on a machine that does many other things
GONE_S = 6.0
"""What the README promises."""
SLACK_S = 10.0


@pytest.fixture
def engine() -> Iterator[DockerClient]:
    require_containers()
    with connected() as engine:
        yield engine


def containers_of(engine: DockerClient, node: str) -> list[Any]:
    """Containers with an agent for a node, running or not."""
    found: list[Any] = engine.containers.list(
        all=True, filters={"label": f"{AGENT_LABEL}={node}"}, ignore_removed=True
    )
    return found


def deployment(folder: Path, nodes: dict[str, str], docker: str = "", **more: Any) -> str:
    host = {"docker": docker or os.environ.get("DOCKER_HOST", "unix:///var/run/docker.sock")}
    content = {"hosts": {"box": {**host, **more}}, "nodes": nodes, "timeout_s": 60}
    file = folder / "deployment.json"
    file.write_text(json.dumps(content))
    return str(file)


Deployed = Callable[..., Running]


@pytest.fixture
def deployed(engine: DockerClient, tmp_path: Path) -> Iterator[Deployed]:
    """``deployed(*ARGUMENTS)``: the stream, nodes of names of its own, the sink with the engine."""
    project = Path(shutil.copytree(STREAM, tmp_path / "stream"))
    file = project / "project.json"
    sink = f"sink_{os.getpid()}"  # found again among the containers of other tests
    file.write_text(file.read_text().replace('"sink"', f'"{sink}"'))

    def begin(*arguments: str) -> Running:
        where = deployment(tmp_path, {sink: "box"})
        return start(project, "--deployment", where, *arguments, cwd=tmp_path)

    yield begin
    wait_until(lambda: not containers_of(engine, sink), UP_S)


def test_nodes_run_in_containers_of_their_own(engine: DockerClient, tmp_path: Path) -> None:
    nodes = {"source": "box", "sink": "box"}
    file = deployment(tmp_path, nodes)
    finished = launch(STREAM, "--deployment", file, "--record", cwd=tmp_path, timeout_s=2 * UP_S)
    assert finished.exit_code == 0, finished.output
    books = finished.connection(CONNECTION)
    assert (books["sent"], books["received"], books["lost"]) == (100, 100, 0)
    assert f"recorded 100 packets on 1 topic: {finished.run_folder}/bag" in finished.output
    assert finished.run_folder is not None
    received = json.loads((finished.run_folder / "sink" / "received.json").read_text())
    assert received["numbers"] == list(range(1, 101))
    machines = finished.record["machines"]
    assert {name: each["nodes"] for name, each in machines.items()} == {
        "box-source": ["source"],
        "box-sink": ["sink"],
    }
    assert machines["box-sink"]["container"]["image"].startswith("neuros_python:")
    wait_until(
        lambda: not containers_of(engine, "source") + containers_of(engine, "sink"),
        GONE_S + SLACK_S,
    )


def test_it_is_said_where_a_node_stood_that_is_killed(engine: DockerClient, tmp_path: Path) -> None:
    file = deployment(tmp_path, {"reader": "box"})
    with start(PROJECTS / "stuck", "--deployment", file, cwd=tmp_path) as running:
        finished = killed_in_a_hook(running, UP_S)
    assert "in compute" in finished.record["nodes"]["reader"]["stack"], finished.output
    wait_until(lambda: not containers_of(engine, "reader"), GONE_S + SLACK_S)


def test_messages_of_the_project_come_along(engine: DockerClient, tmp_path: Path) -> None:
    project = HERE / "custom_messages"
    file = deployment(tmp_path, {"brain": "box"})
    finished = launch(project, "--deployment", file, cwd=tmp_path, timeout_s=2 * UP_S)
    assert finished.exit_code == 0, finished.output
    assert all(books["lost"] == 0 for books in finished.record["connections"])
    assert finished.record["machines"]["box"]["nodes"] == ["brain"]
    wait_until(lambda: not containers_of(engine, "brain"), GONE_S + SLACK_S)


def test_limits_of_a_node_hold_there(deployed: Deployed, engine: DockerClient) -> None:
    limits = '{"memory": "500m", "cpus": 0.5}'
    sink = f"nodes.sink_{os.getpid()}.resources={limits}"
    with deployed(*ENDLESS, "--set", sink) as running:
        running.wait_for("the first image is here", UP_S)
        (container,) = containers_of(engine, f"sink_{os.getpid()}")
        host = container.attrs["HostConfig"]
        assert (host["Memory"], host["NanoCpus"]) == (500 << 20, 500_000_000)
        assert host["CapDrop"] == ["ALL"]
        running.signal(signal.SIGINT)
        finished = running.finish(UP_S)
    assert finished.exit_code == 130, finished.output
    assert finished.record["nodes"][f"sink_{os.getpid()}"]["report"] == "final"


def test_a_container_that_is_killed_ends_the_run(deployed: Deployed, engine: DockerClient) -> None:
    with deployed(*ENDLESS) as running:
        running.wait_for("the first image is here", UP_S)
        (container,) = containers_of(engine, f"sink_{os.getpid()}")
        container.kill()
        finished = running.finish(UP_S)
    assert finished.exit_code == 4, finished.output
    assert "cannot be reached any more" in finished.output


def test_a_killed_launcher_leaves_no_container(deployed: Deployed, engine: DockerClient) -> None:
    with deployed(*ENDLESS) as running:
        running.wait_for("the first image is here", UP_S)
        running.process.kill()
        wait_until(lambda: not containers_of(engine, f"sink_{os.getpid()}"), GONE_S + SLACK_S)


@pytest.mark.needs("docker")
def test_an_engine_that_cannot_be_reached_is_named(tmp_path: Path) -> None:
    file = deployment(tmp_path, {"sink": "box"}, docker=f"unix://{tmp_path}/nowhere")
    finished = launch(STREAM, "--deployment", file, cwd=tmp_path, timeout_s=UP_S)
    assert finished.exit_code == 4, finished.output
    assert f"box (unix://{tmp_path}/nowhere): no Docker engine answers" in finished.output
    assert "Traceback" not in finished.output


def test_without_the_command_docker_it_is_said_how_to_get_it(tmp_path: Path) -> None:
    file = deployment(tmp_path, {"sink": "box"}, docker=f"unix://{tmp_path}/nowhere")
    finished = launch(STREAM, "--deployment", file, cwd=tmp_path, PATH=str(tmp_path))
    assert finished.exit_code == 4, finished.output
    assert "there is no program docker here: sudo apt-get install docker.io" in finished.output


@pytest.mark.needs("docker", "ssh")
def test_so_is_one_behind_an_ssh_without_answer(tmp_path: Path) -> None:
    file = deployment(
        tmp_path, {"sink": "box"}, docker="ssh://nobody@127.0.0.1:1", ssh_options=["-F", "none"]
    )
    finished = launch(STREAM, "--deployment", file, cwd=tmp_path, timeout_s=UP_S)
    assert finished.exit_code == 4, finished.output
    assert "box (ssh://nobody@127.0.0.1:1): ssh has no connection (ssh: connect to host" in (
        finished.output
    )


def test_an_image_that_is_nowhere_is_named(engine: DockerClient, tmp_path: Path) -> None:
    file = deployment(tmp_path, {"sink": "box"})
    wanted = ("--set", "nodes.sink.container=nowhere_to_be_found")
    finished = launch(STREAM, "--deployment", file, *wanted, cwd=tmp_path, timeout_s=UP_S)
    assert finished.exit_code in (3, 4), finished.output
    assert "nowhere_to_be_found" in finished.output
    assert "Traceback" not in finished.output
    assert not containers_of(engine, "sink")
