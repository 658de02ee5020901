"""Tests in containers: what they need, and that they leave nothing.

Without an engine, or without NeuROS's images in it, they are left out, as :mod:`needs` says.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from deadlines import wait_until
from docker import DockerClient
from needs import cannot_run

from neuros.backends.docker.engine import connect
from neuros.backends.docker.images import images_for
from neuros.errors import EnvironmentFault

IMAGES = ("neuros_python", "neuros_mujoco", "neuros_nest")


def require_containers(*names: str) -> None:
    """End the test where containers of these names cannot be started."""
    if reason := _why_not(names or IMAGES[:1]):
        cannot_run("containers", reason)


@cache
def _why_not(names: tuple[str, ...]) -> str:
    try:
        with connected() as engine:
            images_for(names, None, engine)
    except EnvironmentFault as fault:
        return str(fault)
    return ""


@contextmanager
def connected() -> Iterator[DockerClient]:
    """The engine."""
    engine = connect()
    try:
        yield engine
    finally:
        engine.close()


@contextmanager
def nothing_left(folder: Path) -> Iterator[DockerClient]:
    """The engine; afterwards no container of a run below ``folder``, and no new volume, is there.

    Other runs on this machine, and their containers, do not matter.
    """

    def things() -> set[str]:
        volumes = engine.api.volumes()["Volumes"] or []
        containers = engine.api.containers(all=True, filters={"label": "neuros.run_folder"})
        return {volume["Name"] for volume in volumes} - {"neuros_agent"} | {
            f"{container['Names'][0]} ({container['Status']})"
            for container in containers
            if Path(container["Labels"]["neuros.run_folder"]).is_relative_to(folder)
        }

    with connected() as engine:
        before = things()
        yield engine
        wait_until(lambda: not things() - before)
