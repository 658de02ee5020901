"""Who hears whom, with real containers: delivered, or it is said what is waited for.

The table of ``docs/communication.md`` on an engine: what Docker keeps apart by default (IPC
namespace, ``/dev/shm``, user) is what DDS's shared memory loses packets over without a word.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until
from docker import DockerClient
from launching import Running, start
from outside_asker import PROGRAM

from containers import nothing_left, require_containers
from neuros.backends.docker.images import image_for
from neuros.backends.domain import choose_domain
from neuros.doctor.checks import PROJECT as IMAGES
from neuros.transport.dds_profile import RANGE_VARIABLE

ECHO = Path(__file__).parents[1] / "isolation"
NETWORK = ("--network",)

# What a container of the user's is started with; the network of the machine where nothing is said.
PROGRAMS: Mapping[str, Mapping[str, Any]] = {
    "as Docker does by default, root": {"user": "0:0"},
    "another user": {"user": "1234:1234"},
    "IPC of the machine, another user": {"user": "1234:1234", "ipc_mode": "host"},
    "IPC of the machine": {"user": f"{os.getuid()}:{os.getgid()}", "ipc_mode": "host"},
    "discovery on this machine": {"environment": {RANGE_VARIABLE: "LOCALHOST"}},
    "no rights": {"cap_drop": ["ALL"], "security_opt": ["no-new-privileges"]},
}


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with choose_domain(None, {}, False) as chosen:
        yield chosen.id


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[DockerClient]:
    require_containers()
    with nothing_left(tmp_path) as engine:
        yield engine


@contextlib.contextmanager
def echoing(domain: int, folder: Path, *arguments: str) -> Iterator[Running]:
    """A node in a container that answers on external topics."""
    with start(ECHO, "--backend", "docker", "-d", str(domain), *arguments, cwd=folder) as running:
        running.wait_for("[neuros]: ROS domain", 30.0)
        yield running
        running.signal(signal.SIGINT)
        assert running.finish().exit_code == 130


def ask(engine: DockerClient, domain: int, limit_s: float = 20.0, **settings: Any) -> str:
    """Run a plain ROS program in a container; returns what it says if it hears nothing."""
    image = image_for("neuros_python", None, engine)
    environment = {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_LOG_DIR": "/tmp",
        **settings.pop("environment", {}),
    }
    where = {"network_mode": "host"} if "network" not in settings else {}
    container = engine.containers.run(
        image.id,
        entrypoint=[*image.start, "-c", PROGRAM],
        command=[secrets.token_hex(4), str(limit_s)],
        environment=environment,
        detach=True,
        **where,
        **settings,
    )
    try:
        exit_code = container.wait(timeout=limit_s + 30.0)["StatusCode"]
        said = container.logs().decode()
    finally:
        container.remove(force=True)
    return said if exit_code else ""


# ------------------------------------------------------------------ a node and a plain program


@pytest.fixture(scope="module")
def echo(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    require_containers()
    with echoing(domain, tmp_path_factory.mktemp("echo")):
        yield


@pytest.mark.usefixtures("echo")
@pytest.mark.parametrize("settings", PROGRAMS.values(), ids=PROGRAMS)
def test_a_program_in_a_container_of_its_own_hears_and_is_heard(
    engine: DockerClient, domain: int, settings: Mapping[str, Any]
) -> None:
    assert ask(engine, domain, **settings) == ""


def test_on_a_network_of_dockers_it_takes_the_option_network(
    engine: DockerClient, tmp_path: Path
) -> None:
    with used_bridge(engine) as bridge, choose_domain(None, {}, False) as other:
        with echoing(other.id, tmp_path, *NETWORK):
            assert ask(engine, other.id, network=bridge) == ""
        with echoing(other.id, tmp_path) as alone:
            assert "no answer; 0 listen" in ask(engine, other.id, 1.0, network=bridge)
            alone.wait_for("a container with a network of its own")


@contextlib.contextmanager
def used_bridge(engine: DockerClient) -> Iterator[str]:
    """A network of Docker's that has a container: without one it is down, and DDS passes it over.

    Fast DDS looks once, as a node starts, which networks there are.
    """
    bridge = engine.networks.create(f"neuros-test-{secrets.token_hex(4)}", driver="bridge")
    with contextlib.ExitStack() as undo:
        undo.callback(bridge.remove)
        image = image_for("neuros_python", None, engine)
        container = engine.containers.run(
            image.id,
            entrypoint=[*image.start, "-c", "import signal; signal.pause()"],
            detach=True,
            network=bridge.name,
        )
        undo.callback(container.remove, force=True)
        state = Path(f"/sys/class/net/br-{bridge.id[:12]}/operstate")
        wait_until(lambda: state.read_text().strip() == "up")
        yield str(bridge.name)


# ------------------------------------------------------------------ nodes of two launchers

SIDES = {
    "containers of two runs": ("docker", ()),
    "a container and a process": ("process", ()),
    "a container and a process, found on the network": ("process", NETWORK),
}


@pytest.mark.parametrize(("backend", "reach"), SIDES.values(), ids=SIDES)
def test_images_go_between_the_nodes_of_two_launchers(
    engine: DockerClient, domain: int, tmp_path: Path, backend: str, reach: tuple[str, ...]
) -> None:
    def side(node: str, backend: str) -> Running:
        arguments = ("-n", node, "--backend", backend, "-d", str(domain), "-o", node, *reach)
        return start(IMAGES, *arguments, cwd=tmp_path)

    with side("eye", backend) as eye, side("camera", "docker") as camera:
        camera.wait_for("20 images of 921600 bytes have arrived", 60.0)
        assert camera.finish().exit_code == 0
        assert eye.finish().exit_code == 0, "the end of one side is the end of the other"
