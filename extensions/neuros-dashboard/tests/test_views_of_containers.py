"""What is seen of nodes in containers, and tools that are in a container themselves."""

from __future__ import annotations

import io
import signal
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import wait_until
from docker import DockerClient
from endings import GONE_WITHIN_S
from launching import start
from neuros_dashboard.windows import TOOL_IMAGE
from visitor import WATCHED, Visitor, address, is_full

from containers import connected, require_containers
from neuros.backends.domain import choose_domain

# A stand-in for the tools of a ROS distribution, which no test machine has the gigabytes for.
TOOL = '#!/bin/sh\necho "$ROS_DOMAIN_ID $DISPLAY"; head -n 1 "$2"; exec sleep 60\n'


@pytest.fixture
def engine() -> Iterator[DockerClient]:
    require_containers("neuros_python")
    with connected() as client:
        yield client


@pytest.fixture
def tools(engine: DockerClient) -> Iterator[None]:
    """An image of tools, which goes with the test."""
    if engine.images.list(name=TOOL_IMAGE):
        pytest.skip(f"the image {TOOL_IMAGE} is there, and is not to be replaced by a stand-in")
    files = {"rviz2": TOOL, "Dockerfile": "FROM neuros_python\nCOPY rviz2 /usr/local/bin/\n"}
    files["Dockerfile"] += "ENTRYPOINT []\n"
    context = io.BytesIO()
    with tarfile.open(fileobj=context, mode="w") as tar:
        for name, text in files.items():
            info = tarfile.TarInfo(name)
            info.size, info.mode = len(text), 0o755
            tar.addfile(info, io.BytesIO(text.encode()))
    context.seek(0)
    engine.images.build(fileobj=context, custom_context=True, tag=TOOL_IMAGE, rm=True)
    yield
    engine.images.remove(TOOL_IMAGE, force=True)


def is_below(folder: str, parent: Path) -> bool:
    return Path(folder).is_relative_to(parent)


@pytest.mark.usefixtures("engine")
def test_the_dashboard_shows_and_ends_nodes_in_containers(tmp_path: Path) -> None:
    with start(WATCHED, "--dashboard", "--backend", "docker", cwd=tmp_path) as running:
        visitor = Visitor(address(running))
        with visitor.events() as events:
            figures = next(data for name, data in events if name == "figures" and is_full(data))
            assert figures["nodes"].keys() == {"world", "brain"}
            assert visitor.post("/do/stop") == 204
        assert running.finish(30.0).exit_code == 0


@pytest.mark.usefixtures("tools")
def test_a_tool_in_a_container_sees_the_run_and_goes_with_a_killed_launcher(
    tmp_path: Path, engine: DockerClient
) -> None:
    def containers() -> list[str]:
        found = engine.containers.list(filters={"ancestor": TOOL_IMAGE})
        return [
            each.id for each in found if each.labels["neuros.run_folder"].startswith(str(tmp_path))
        ]

    with choose_domain(None, {}, False) as domain:
        arguments = ("-z", "-d", str(domain.id), "--backend", "process")
        with start(
            WATCHED, *arguments, cwd=tmp_path, DISPLAY=":7", PATH="/usr/bin:/bin"
        ) as running:
            running.wait_for("rviz2: a window on this display")
            (tool,) = containers()
            wait_until(
                lambda: engine.containers.get(tool).logs() == f"{domain.id} :7\n{{\n".encode()
            )
            running.signal(signal.SIGKILL)
            wait_until(lambda: not containers(), GONE_WITHIN_S)
