"""Containers of a run: one for each node."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import requests
from docker import DockerClient
from docker.errors import DockerException

from neuros.backends.docker import leftovers
from neuros.backends.docker.engine import (
    Abilities,
    connect,
    engine_faults,
    engine_name,
    engine_socket,
)
from neuros.backends.docker.images import images_for
from neuros.backends.docker.leftovers import RUN_LABEL
from neuros.backends.docker.settings import (
    NETWORK_MODE,
    NO_NETWORK,
    as_here,
    container_name,
    container_settings,
    inside,
    shared_memory,
)
from neuros.backends.node_command import (
    last_line,
    log_file,
    node_folder,
    on_cores,
    script_failure,
    signal_in_words,
)
from neuros.backends.run_processes import RUN_ID, RunProcesses, started_at
from neuros.backends.shared_memory import hold
from neuros.errors import EnvironmentFault, results_of
from neuros.ports import Deployment, NodeProgram, Notice
from neuros.project.load import PROJECT_FILE
from neuros.project.model import Folders, Node, NodeFile, memory_text
from neuros.stacks import ProcessThreads, threads_of

_MOST_AT_ONCE = 16
_OUT_OF_MEMORY = 128 + signal.SIGKILL
_NOT_EXECUTED = (125, 126, 127)
_PAUSED = "the container is paused"
_STOPPED = "the Docker engine stopped it: by `docker stop`, or because the engine itself ended"
# The engine removes a container as soon as it has ended. If it cannot, its node has ended anyway.
_REMOVAL_S = 2.0


class Containers(Deployment):
    """Containers for nodes: the engine, what it can do, and the image of each container.

    Raises:
        EnvironmentFault: if there is no engine, or an image is not there.
    """

    def __init__(self, nodes: Sequence[Node], project_folder: Path) -> None:
        self.engine = connect()
        try:
            with engine_faults("Docker"):
                self.abilities = Abilities.of(self.engine.info())
            names = [node.container for node in nodes]
            self.images = images_for(names, project_folder, self.engine)
        except BaseException:
            self.engine.close()
            raise
        self.notices = [
            *(("WARN", each.notice) for each in self.images.values() if each.notice),
            *without_limits(nodes, self.abilities.unkept),
        ]
        blind = [node.name for node in nodes if node.access.display]
        if blind and not os.environ.get("DISPLAY"):
            self.notices.append(("WARN", f"no windows of {', '.join(blind)}: DISPLAY is not set"))

    def launcher(self, program: NodeProgram) -> DockerLauncher:
        return DockerLauncher(self, program)

    def as_seen(self, file: NodeFile) -> NodeFile:
        return inside(file)

    def as_here(self, text: str, folders: Folders) -> str:
        return as_here(text, folders)

    def record(self) -> Mapping[str, Any]:
        try:
            with engine_faults("Docker"):
                version = engine_name(self.engine.version())
        except EnvironmentFault:  # the engine has gone away, of which the run has ended
            return {"docker": None}
        images = {name: {"name": each.name, "id": each.id} for name, each in self.images.items()}
        return {"docker": {"engine": version, "images": images}}


def without_limits(nodes: Sequence[Node], unkept: Collection[str]) -> Sequence[Notice]:
    """One line on limits that the engine does not keep."""
    asking = [
        node.name
        for node in nodes
        if any(getattr(node.resources, limit) is not None for limit in unkept)
    ]
    if not asking:
        return ()
    text = (
        f"resources of {', '.join(asking)} have no effect: this Docker engine has no control"
        " groups for them (docker info)"
    )
    return [("WARN", text)]


class DockerLauncher:
    """Starts one container per node (:class:`neuros.ports.Launcher`).

    The guardian gets the engine, and the folder that the containers share, before the first
    container.
    """

    def __init__(self, containers: Containers, program: NodeProgram) -> None:
        self._containers = containers
        self._engine = containers.engine
        self._program = program

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningContainer]:
        """Start a container per node, side by side, all or none. Raises ``EnvironmentFault``."""
        run_id = environment.get(RUN_ID, "")
        folder = shared_memory(run_id)
        socket = engine_socket(self._engine)
        if self._program.guardian:
            self._program.guardian.clean_with(leftovers.__name__, socket)
            self._program.guardian.remove_later(folder)
        try:
            folder.mkdir(mode=0o700)
            hold(folder)
        except OSError as error:
            raise EnvironmentFault(f"no shared memory for containers: {error}") from error
        with engine_faults("the engine's events cannot be listened to"):
            events = ContainerEvents(self._engine, run_id)
        events.start()
        # Entries of the run folder that not all nodes may write to.
        entries = sorted(nodes[0].folders.run.iterdir())
        others = [path for path in entries if path.is_dir() or path.name == PROJECT_FILE]
        networks = [NETWORK_MODE] * len(nodes)
        if self._program.is_isolated:  # the run has a network of its own, that of its first node
            first = container_name(nodes[0], run_id)
            networks = [NO_NETWORK, *[f"container:{first}"] * (len(nodes) - 1)]

        def start(file: NodeFile, network: str) -> RunningContainer:
            settings = container_settings(
                file,
                self._containers.images[file.node.container],
                self._program,
                environment,
                others=[path for path in others if path != node_folder(file)],
                launcher_pid=os.getpid(),
                network=network,
                is_rootless=self._containers.abilities.is_rootless,
            )
            with engine_faults(f"the container of node '{file.node.name}' cannot be started"):
                container = self._engine.containers.create(**settings)
                container.start()
            return RunningContainer(file, str(container.id), self._engine, events)

        with ThreadPoolExecutor(_MOST_AT_ONCE, "neuros-docker") as threads:
            work = []
            for node, network in zip(nodes, networks, strict=True):
                work.append(threads.submit(start, node, network))
                if network == NO_NETWORK and work[0].exception():  # the others need it
                    break
        started, failed = results_of(work)
        if failed is not None:
            events.close()
            for container in started:
                container.kill()
            raise failed
        return started

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        lines = []
        for file in nodes:
            node, image = file.node, self._containers.images[file.node.container]
            resources, access = node.resources, node.access
            memory = resources.mem_bytes
            facts = [
                *([f"memory {memory_text(memory)}"] if memory is not None else []),
                *([f"cpus {resources.cpus:g}"] if resources.cpus is not None else []),
                *([f"pids {resources.pids}"] if resources.pids is not None else []),
                *(f"device {device}" for device in access.devices),
                *([f"gpus {' '.join(access.gpus)}"] if access.gpus else []),
                *(["display"] if access.display else []),
                f"log: {log_file(file)}",
            ]
            where = on_cores(self._program.cores.get(node.name))
            command = shlex.join(self._program.command(image.start))
            lines.append(
                f"container {node.name}{where} of image {image.name}: {command}"
                f" ({'; '.join(facts)})"
            )
        return lines


class RunningContainer:
    """A container with one node (:class:`neuros.ports.RunningNode`).

    No method waits for the engine: requests run in a thread, and events tell their effect.

    Attributes:
        id: of the container.
    """

    def __init__(
        self, file: NodeFile, container_id: str, engine: DockerClient, events: ContainerEvents
    ) -> None:
        self._file = file
        self.names = (file.node.name,)
        self.id = container_id
        self._engine = engine
        self._events = events
        self._is_killed = False
        events.add(container_id)

    def poll(self) -> str | None:
        end = self._events.end_of(self.id)
        if end is not None:
            words = how_it_ended(*end, log_file(self._file), self._file.node.resources.mem_bytes)
            is_stopped = self._events.fate(self.id).is_signalled and not self._is_killed
            return f"{words}: {_STOPPED}" if is_stopped else words
        if self._events.lost and not self._events.pids(self._file.node.name):
            return f"the Docker engine went away ({self._events.lost}): start it again"
        return None

    @property
    def is_abandoned(self) -> bool:
        return bool(self._events.lost) and self._events.end_of(self.id) is None

    def kill(self) -> None:
        self._is_killed = True
        if self._events.lost:
            self._events.signal_all(signal.SIGKILL, self._file.node.name)
        else:

            def tell_engine() -> None:
                # It may have ended meanwhile, which the events tell.
                with contextlib.suppress(DockerException, requests.RequestException):
                    self._engine.api.kill(self.id)

            threading.Thread(target=tell_engine, daemon=True).start()

    def threads(self) -> ProcessThreads:
        """The Python stacks of its threads; the first of its processes may be an init program."""
        read = ProcessThreads()
        for pid in self._events.pids(self._file.node.name):
            read = threads_of(pid)
            if read.threads:
                break
        return replace(read, stopped=_PAUSED) if self._events.fate(self.id).is_paused else read


def how_it_ended(exit_code: int, is_out_of_memory: bool, log: Path, mem_bytes: int | None) -> str:
    """The end of a container, in words.

    Args:
        log: of the node; its last line names a program that could not be executed.
        mem_bytes: its limit of memory, ``None`` if it has none of its own.
    """
    limit = f" (limit {memory_text(mem_bytes)})" if mem_bytes is not None else ""
    if is_out_of_memory and exit_code == _OUT_OF_MEMORY:
        return f"out of memory{limit}"
    if exit_code == 1 and (failure := script_failure(log)):
        return failure
    words = f"exit code {exit_code}"
    if exit_code > 128:
        words = signal_in_words(exit_code - 128)
    elif exit_code in _NOT_EXECUTED and (said := last_line(log)):
        words += f": {said}"
    return words + (f", after a process of it ran out of memory{limit}" if is_out_of_memory else "")


@dataclass
class Fate:
    """Events of a container so far.

    Attributes:
        exit_code: ``None`` while it runs.
        is_signalled: whether the engine has sent it a signal.
        is_paused: whether the engine has frozen it (``docker pause``).
        is_gone: whether it is removed.
    """

    exit_code: int | None = None
    died_s: float = 0.0
    is_out_of_memory: bool = False
    is_signalled: bool = False
    is_paused: bool = False
    is_gone: bool = False


class ContainerEvents(threading.Thread):
    """Receives the engine's events about the containers of a run, in a thread.

    A container counts as ended when it is removed: then its last event has arrived (that memory
    ran out may follow on the exit code).

    If the engine goes away, the nodes get SIGTERM, and their processes count from then on.

    Attributes:
        lost: why the connection to the engine has ended, empty while it lasts.
    """

    def __init__(self, engine: DockerClient, run_id: str) -> None:
        super().__init__(name="neuros-containers", daemon=True)
        self.lost = ""
        self._run_id = run_id
        self._fates: dict[str, Fate] = {}
        self._awaited: set[str] = set()
        self._is_closing = False
        self._stream: Any = engine.events(
            decode=True,
            since=int(time.time()) - 1,
            filters={"type": "container", "label": f"{RUN_LABEL}={run_id}"},
        )

    def run(self) -> None:
        """Receive until the end of the last container, :meth:`close`, or the end of the engine."""
        reason = "it closed the connection"
        try:
            for event in self._stream:
                action, actor = event["Action"], event["Actor"]
                fate = self.fate(actor["ID"])
                if action == "oom":
                    fate.is_out_of_memory = True
                elif action == "kill":
                    fate.is_signalled = True
                elif action in ("pause", "unpause"):
                    fate.is_paused = action == "pause"
                elif action == "die":
                    fate.died_s = time.monotonic()
                    fate.exit_code = int(actor["Attributes"]["exitCode"])
                elif action in ("destroy", "remove"):  # podman says remove
                    fate.is_gone = True
        except (DockerException, requests.RequestException, OSError, ValueError) as error:
            reason = str(error)
        if not self._is_closing:
            self.lost = reason
            self.signal_all(signal.SIGTERM)

    def close(self) -> None:
        self._is_closing = True
        with contextlib.suppress(OSError, DockerException):
            self._stream.close()

    def add(self, container_id: str) -> None:
        """Keep the connection until :meth:`end_of` has told the end of this container."""
        self._awaited.add(container_id)

    def end_of(self, container_id: str) -> tuple[int, bool] | None:
        """The exit code of a container and whether it ran out of memory; ``None`` while it runs."""
        fate = self.fate(container_id)
        if fate.exit_code is None:
            return None
        if not fate.is_gone and time.monotonic() - fate.died_s < _REMOVAL_S:
            return None
        self._awaited.discard(container_id)
        if not self._awaited:
            self.close()
        return fate.exit_code, fate.is_out_of_memory

    def fate(self, container_id: str) -> Fate:
        return self._fates.setdefault(container_id, Fate())

    def pids(self, node: str | None = None) -> Sequence[int]:
        """Process ids of a node, or of all, on this machine; the oldest first."""
        found = RunProcesses(self._run_id).nodes()
        mine = (pid for pid in found if node in (None, found[pid]))
        return sorted(mine, key=lambda pid: started_at(pid) or 0)

    def signal_all(self, number: int, node: str | None = None) -> None:
        """Send a signal to the processes of the run, or of one node, without the engine."""
        for pid in self.pids(node):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, number)
