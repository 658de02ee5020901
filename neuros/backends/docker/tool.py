"""Graphical tools of ROS in a container of the image ``neuros_tools``."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import requests
from docker.errors import DockerException, ImageNotFound

from neuros.backends.docker import leftovers
from neuros.backends.docker.engine import connect, engine_faults, engine_socket
from neuros.backends.docker.leftovers import RUN_LABEL
from neuros.backends.run_processes import RUN_ID
from neuros.distribution import build_command
from neuros.errors import EnvironmentFault
from neuros.ports import Reaper

IMAGE = "neuros_tools"
_X11 = Path("/tmp/.X11-unix")
_STOP_S = 2


def find_tool_image(environ: Mapping[str, str] = os.environ) -> str | None:
    """``None`` if there is the image, else in a few words why not."""
    try:
        engine = connect(environ)
    except EnvironmentFault:
        return f"there is no Docker engine for the image {IMAGE}"
    try:
        engine.images.get(IMAGE)
    except ImageNotFound:
        return f"the image {IMAGE} is not built ({build_command(IMAGE)})"
    except (DockerException, requests.RequestException) as error:
        return f"the Docker engine does not say whether it has the image {IMAGE}: {error}"
    finally:
        engine.close()
    return None


class ToolContainer:
    """A tool in a container: the host's network and display, the run folder to read.

    Raises:
        EnvironmentFault: if it cannot be started.
    """

    def __init__(
        self, program: str, arguments: Sequence[str], run: Path, environment: Mapping[str, str]
    ) -> None:
        self._engine = connect()
        with engine_faults(f"{program} in a container of {IMAGE}"):
            self._container = self._engine.containers.run(
                IMAGE,
                [program, *arguments],
                detach=True,
                auto_remove=True,
                environment=_environment(environment, os.environ),
                labels={
                    RUN_LABEL: environment.get(RUN_ID, ""),
                    "neuros.run_folder": str(run),
                },
                mounts=list(_mounts(run, os.environ)),
                network_mode="host",
                ipc_mode="host",
                user=f"{os.getuid()}:{os.getgid()}",
                cap_drop=["ALL"],
                security_opt=["no-new-privileges"],
            )

    def announce(self, reaper: Reaper) -> None:
        """Have it removed if the launcher is killed."""
        reaper.clean_with(leftovers.__name__, engine_socket(self._engine))

    def finish(self) -> None:
        """End it with the run."""
        with contextlib.suppress(DockerException, requests.RequestException):
            self._container.stop(timeout=_STOP_S)  # its window may have been closed long ago
        self._engine.close()


def _environment(added: Mapping[str, str], environ: Mapping[str, str]) -> dict[str, str]:
    passed = {key: environ[key] for key in ("DISPLAY", "XAUTHORITY") if key in environ}
    return {**added, **passed, "HOME": "/tmp", "ROS_LOG_DIR": "/tmp"}


def _mounts(run: Path, environ: Mapping[str, str]) -> list[dict[str, Any]]:
    paths = [run, _X11, *map(Path, filter(None, [environ.get("XAUTHORITY")]))]
    return [
        {"Type": "bind", "Source": str(path), "Target": str(path), "ReadOnly": True}
        for path in paths
        if path.exists()
    ]
