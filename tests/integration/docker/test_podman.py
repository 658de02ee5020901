"""Containers of a rootless podman give the guarantees of all back ends.

For an ordinary user whose podman has the image neuros_python (``docker save | podman load``).
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from needs import cannot_run, require

from containers import wait_until
from neuros.testing.back_ends import BackEndChecks, Launched

pytestmark = pytest.mark.acceptance


@pytest.fixture(scope="session")
def podman(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service of this user's."""
    require("podman")
    listed = subprocess.run(["podman", "images", "-q", "neuros_python"], capture_output=True)
    if not listed.stdout:
        cannot_run("the image neuros_python in podman: docker save neuros_python | podman load")
    socket = tmp_path_factory.mktemp("podman") / "s"
    address = f"unix://{socket}"
    service = subprocess.Popen(["podman", "system", "service", "--time=0", address])
    try:
        wait_until(socket.is_socket)
        yield address
    finally:
        service.terminate()
        service.wait()


@pytest.fixture(autouse=True)
def used(podman: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DOCKER_HOST", podman)


class TestPodman(BackEndChecks):
    back_end = "docker"

    def test_the_record_says_which_engine_it_was(self, run: Callable[..., Launched]) -> None:
        assert run("pipeline").record["docker"]["engine"].startswith("podman ")


def test_nothing_of_a_run_is_left_in_podman(tmp_path: Path) -> None:
    listed = subprocess.run(
        ["podman", "ps", "--all", "--quiet", "--filter", "label=neuros.run"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert listed.stdout == ""
