"""The Docker back end: one container per node."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from docker import DockerClient

from neuros.errors import EnvironmentFault
from neuros.launch.dead_runs import hold
from neuros.launch.docker.container import RunningContainer
from neuros.launch.docker.engine import Abilities, connect, engine_faults, engine_socket
from neuros.launch.docker.images import Image, images_for
from neuros.launch.docker.settings import DDS_SETTINGS, User, container_settings, shared_memory
from neuros.launch.docker.watch import ContainerWatch
from neuros.launch.host_command import log_file, node_folder
from neuros.launch.placement import Cores, on_cores
from neuros.launch.run_processes import RUN_ID
from neuros.project.load import PROJECT_FILE
from neuros.project.model import NodeFile
from neuros.project.resources import memory_text

_MOST_AT_ONCE = 16


@dataclass(frozen=True)
class Containers:
    """The engine, what it can do, and the image of every container that nodes name."""

    engine: DockerClient
    images: Mapping[str, Image]
    abilities: Abilities

    def record(self) -> dict[str, Any]:
        """What there is to know of them later, ready for JSON. Raises ``EnvironmentFault``."""
        with engine_faults("Docker"):
            version = self.engine.version()["Version"]
        images = {
            container: {"name": image.name, "id": image.id}
            for container, image in self.images.items()
        }
        return {"engine": version, "images": images}


def find_containers(names: Iterable[str], project_folder: Path | None) -> Containers:
    """What containers of these names are started from.

    Raises:
        EnvironmentFault: if there is no engine, or an image is not there.
    """
    engine = connect()
    try:
        with engine_faults("Docker"):
            abilities = Abilities.of(engine.info())
        return Containers(engine, images_for(names, project_folder, engine), abilities)
    except BaseException:
        engine.close()
        raise


class DockerLauncher:
    """Starts one container per node (:class:`neuros.ports.Launcher`).

    Args:
        options: of the command ``node``, as ``--debug``.
        on_started: is told the socket of the engine, and a folder that is to be removed in the end,
            before the first container is made.
        placement: the cores of each node, by name; the kernel places those that are not in it.
    """

    def __init__(
        self,
        containers: Containers,
        options: Sequence[str] = (),
        on_started: Callable[[str, Path], None] | None = None,
        placement: Mapping[str, Cores] = MappingProxyType({}),
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        self._engine = containers.engine
        self._images = containers.images
        self._options = tuple(options)
        self._on_started = on_started
        self._placement = placement
        self._environ = environ
        self._is_rootless = containers.abilities.is_rootless

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningContainer]:
        """Start a container per node, side by side, all or none. Raises ``EnvironmentFault``."""
        folder = shared_memory(environment.get(RUN_ID, ""))
        if self._on_started:
            self._on_started(engine_socket(self._engine), folder)
        try:
            folder.mkdir(mode=0o700)
            hold(folder)
        except OSError as error:
            raise EnvironmentFault(f"no shared memory for containers: {error}") from error
        with engine_faults("the engine's events cannot be listened to"):
            watch = ContainerWatch(self._engine, environment.get(RUN_ID, ""))
        watch.start()
        in_run_folder = _in_run_folder(nodes)
        with ThreadPoolExecutor(_MOST_AT_ONCE, "neuros-docker") as threads:
            work = [
                threads.submit(self._start_one, node, environment, watch, in_run_folder)
                for node in nodes
            ]
        faults = [fault for each in work if (fault := each.exception())]
        started = [each.result() for each in work if not each.exception()]
        if not faults:
            return started
        watch.close()
        for container in started:
            container.kill()
        others = [fault for fault in faults if not isinstance(fault, EnvironmentFault)]
        if others:
            raise others[0]
        raise EnvironmentFault("\n".join(dict.fromkeys(map(str, faults))))

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per container."""
        return [self._description(node) for node in nodes]

    def _start_one(
        self,
        file: NodeFile,
        environment: Mapping[str, str],
        watch: ContainerWatch,
        in_run_folder: Sequence[Path],
    ) -> RunningContainer:
        name, mem_bytes = file.node.name, file.node.resources.mem_bytes
        with engine_faults(f"the container of node '{name}' cannot be started"):
            container = self._engine.containers.create(
                **self._settings(file, environment, in_run_folder)
            )
            container.start()
        return RunningContainer(
            name,
            str(container.id),
            self._engine,
            watch,
            log=log_file(file),
            mem_bytes=mem_bytes,
        )

    def _settings(
        self, file: NodeFile, environment: Mapping[str, str], in_run_folder: Sequence[Path]
    ) -> dict[str, Any]:
        return container_settings(
            file,
            self._images[file.node.container],
            user_for(file, self._environ, is_rootless=self._is_rootless),
            self._options,
            environment,
            others=[path for path in in_run_folder if path != node_folder(file)],
            cores=self._placement.get(file.node.name),
            launcher_pid=os.getpid(),
        )

    def _description(self, file: NodeFile) -> str:
        node, image = file.node, self._images[file.node.container]
        command = shlex.join([*image.start, "-m", "neuros.cli", "node", *self._options])
        facts = [*_limits(file), *_openings(file), f"log: {log_file(file)}"]
        where = on_cores(self._placement.get(node.name))
        return f"container {node.name}{where} of image {image.name}: {command} ({'; '.join(facts)})"


def _in_run_folder(nodes: Sequence[NodeFile]) -> list[Path]:
    """What is there before any node runs, and is not to be written by all: folders, the project."""
    entries = sorted(nodes[0].folders.run.iterdir())
    return [path for path in entries if path.is_dir() or path.name == PROJECT_FILE]


def user_for(file: NodeFile, environ: Mapping[str, str], *, is_rootless: bool = False) -> User:
    """The caller, as far as a node is let in to what belongs to the caller.

    Whoever runs a rootless engine is called root in its containers, with the same few rights.

    Raises:
        EnvironmentFault: if a device of the node, or a file with settings of DDS, is not there.
    """
    groups = {_group_of(file, device) for device in file.node.access.devices}
    key = Path(environ.get("XAUTHORITY") or Path(environ.get("HOME", "/")) / ".Xauthority")
    return User(
        0 if is_rootless else os.getuid(),
        0 if is_rootless else os.getgid(),
        () if is_rootless else tuple(sorted(groups.intersection(os.getgroups()))),
        environ,
        key if file.node.access.display and key.is_file() else None,
        _dds_settings(environ.get(DDS_SETTINGS)),
    )


def _dds_settings(named: str | None) -> Path | None:
    if not named:
        return None
    path = Path(named).absolute()
    if not path.is_file():
        raise EnvironmentFault(
            f"{DDS_SETTINGS}={named}: there is no such file: unset it, or name one"
        )
    return path


def _group_of(file: NodeFile, device: str) -> int:
    try:
        return os.stat(device).st_gid
    except OSError as error:
        raise EnvironmentFault(
            f"node '{file.node.name}' asks for the device {device}: {error.strerror}: is it plugged"
            f" in? Another one: --set nodes.{file.node.name}.devices='[\"/dev/...\"]'"
        ) from error


def _limits(file: NodeFile) -> list[str]:
    resources = file.node.resources
    facts = []
    if resources.mem_bytes is not None:
        facts.append(f"memory {memory_text(resources.mem_bytes)}")
    if resources.cpus is not None:
        facts.append(f"cpus {resources.cpus:g}")
    if resources.pids is not None:
        facts.append(f"pids {resources.pids}")
    return facts


def _openings(file: NodeFile) -> list[str]:
    access = file.node.access
    facts = [f"device {device}" for device in access.devices]
    if access.gpus:
        facts.append(f"gpus {' '.join(access.gpus)}")
    if access.display:
        facts.append("display")
    return facts
