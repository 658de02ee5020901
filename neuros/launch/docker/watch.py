"""What becomes of the containers of a run, as the engine tells it.

One thread listens to the engine's events, so that whoever asks never waits for the engine. A
container counts as ended when it is gone: then all that the engine has to say of it has come (that
memory ran out may follow on the exit code), and nothing of it is left.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from dataclasses import dataclass
from typing import Any

import requests
from docker import DockerClient
from docker.errors import DockerException

from neuros.launch.leftover_containers import RUN_LABEL
from neuros.launch.run_processes import RunProcesses

# The engine removes a container as soon as it has ended. If it cannot, its node has ended anyway.
_REMOVAL_S = 2.0


@dataclass
class _Fate:
    """What is known of a container; ``exit_code`` is ``None`` while it runs."""

    exit_code: int | None = None
    died_s: float = 0.0
    is_out_of_memory: bool = False
    is_signalled: bool = False
    is_gone: bool = False


class ContainerWatch(threading.Thread):
    """Listens to the engine from before the first container of a run to the end of the last.

    Where the engine goes away, the nodes are asked to end by themselves (SIGTERM), and judged by
    their processes from then on.

    Attributes:
        lost: why the engine is not heard any more, empty while it is.
    """

    def __init__(self, engine: DockerClient, run_id: str) -> None:
        super().__init__(name="neuros-containers", daemon=True)
        self.lost = ""
        self._run_id = run_id
        self._fates: dict[str, _Fate] = {}
        self._awaited: set[str] = set()
        self._is_closing = False
        self._stream: Any = engine.events(
            decode=True,
            since=int(time.time()) - 1,
            filters={"type": "container", "label": f"{RUN_LABEL}={run_id}"},
        )

    def run(self) -> None:
        """Until the end of the last container, :meth:`close`, or the end of the engine."""
        reason = "it closed the connection"
        try:
            for event in self._stream:
                self._take(event)
        except (DockerException, requests.RequestException, OSError, ValueError) as error:
            reason = str(error)
        if not self._is_closing:
            self.lost = reason
            self.signal_all(signal.SIGTERM)

    def close(self) -> None:
        """Listen no more."""
        self._is_closing = True
        with contextlib.suppress(OSError, DockerException):
            self._stream.close()

    def add(self, container_id: str) -> None:
        """Somebody will ask for the end of this container."""
        self._awaited.add(container_id)

    def end_of(self, container_id: str) -> tuple[int, bool] | None:
        """The exit code of a container and whether it ran out of memory; ``None`` if it runs on."""
        fate = self._fates.get(container_id)
        if fate is None or fate.exit_code is None:
            return None
        if not fate.is_gone and time.monotonic() - fate.died_s < _REMOVAL_S:
            return None
        self._awaited.discard(container_id)
        if not self._awaited:
            self.close()
        return fate.exit_code, fate.is_out_of_memory

    def is_signalled(self, container_id: str) -> bool:
        """Whether the engine has sent it a signal, whoever asked for that."""
        fate = self._fates.get(container_id)
        return fate is not None and fate.is_signalled

    def has_processes(self, node: str) -> bool:
        """Whether processes of a node are there, as this machine sees it."""
        return node in RunProcesses(self._run_id).nodes().values()

    def signal_all(self, number: int, node: str | None = None) -> None:
        """Send a signal to the processes of the run, or of one node, without the engine."""
        for pid, name in RunProcesses(self._run_id).nodes().items():
            if node in (None, name):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, number)

    def _take(self, event: dict[str, Any]) -> None:
        actor = event["Actor"]
        fate = self._fates.setdefault(actor["ID"], _Fate())
        if event["Action"] == "oom":
            fate.is_out_of_memory = True
        elif event["Action"] == "kill":
            fate.is_signalled = True
        elif event["Action"] == "die":
            fate.died_s = time.monotonic()
            fate.exit_code = int(actor["Attributes"]["exitCode"])
        elif event["Action"] == "destroy":
            fate.is_gone = True
