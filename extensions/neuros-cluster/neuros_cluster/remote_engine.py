"""Nodes in containers of an engine on another machine, which needs nothing but that engine.

Each node has a container with an agent (:mod:`neuros_cluster.agent`), to which the launcher talks
over the standard input and output of ``docker start --attach``. An engine behind ``ssh`` is reached
through a tunnel to its socket. An image that the engine lacks is copied from the engine of this
machine. NeuROS and built message packages are copied into each container; received project files
are kept in a volume of the engine.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import subprocess
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from urllib.parse import urlsplit

import requests
from docker import DockerClient
from docker.errors import DockerException, NotFound

from neuros.backends.containers import for_all
from neuros.backends.docker.engine import (
    OR_WITHOUT,
    Abilities,
    connect,
    engine_faults,
    engine_socket,
    require_program,
)
from neuros.backends.docker.images import Image, image_for
from neuros.backends.docker.settings import LIBRARY, MESSAGES, NETWORK_MODE, ROOT, limits
from neuros.backends.node_command import DEFAULTS, without_mark
from neuros.distribution import libraries, python_command
from neuros.errors import EnvironmentFault
from neuros.project.model import Node, memory_text
from neuros_cluster.deployment_file import Host

AGENT_LABEL = "neuros.agent"
"""The label of every container with an agent."""

VOLUME = "neuros_agent"
"""The volume with the files that agents have received."""

_CACHE = ROOT / "cache"
_USER = 1000  # as in the images of NeuROS
_SOCKET = "/var/run/docker.sock"
_FORWARDING = ("-o", "ExitOnForwardFailure=yes")
_CONNECT_S = 30.0
_POLL_S = 0.02
_NEVER_STARTED_S = 60.0
_REMOVAL_S, _GONE_S = 2.0, 0.1

Log = Callable[[str, str], None]


class RemoteEngine:
    """The engine of a host; must be closed.

    Args:
        ssh: the command ``ssh`` with NeuROS's options.

    Attributes:
        reached_at: the address of the machine, if the way to it tells; else empty.

    Raises:
        EnvironmentFault: the engine cannot be reached.
    """

    def __init__(self, host: Host, ssh: Sequence[str]) -> None:
        self.host = host
        self.reached_at = ""
        self._held = contextlib.ExitStack()
        try:
            require_program()
            where = urlsplit(host.docker)
            self._address = self._tunnelled(ssh) if where.scheme == "ssh" else host.docker
            self.reached_at = self.reached_at or where.hostname or "127.0.0.1"
            found = {**os.environ, "DOCKER_HOST": self._address}
            self._engine = connect(found, timeout_s=None)
            self._held.callback(self._engine.close)
            if where.scheme == "unix":  # a rootless engine has another socket than the usual one
                self._address = f"unix://{engine_socket(self._engine)}"
            with engine_faults("Docker"):
                self._is_rootless = Abilities.of(self._engine.info()).is_rootless
        except BaseException as error:
            self.close()
            if isinstance(error, EnvironmentFault):
                why = str(error).removesuffix(f", {OR_WITHOUT}")  # a remote node needs the engine
                raise EnvironmentFault(f"{host}: {why}") from error
            raise

    def container(self, node: Node, project: Path, log: Log) -> AgentContainer:
        """Make the container of a node, and copy its image if necessary.

        Raises:
            EnvironmentFault: there is no image, or the engine refuses.
        """
        try:
            image = self._image(node.container, project, log)
            with engine_faults(f"the container of node '{node.name}'"):
                # Containers whose launcher was killed before their start are never started.
                wanted = {"label": AGENT_LABEL, "status": "created"}
                for container in self._engine.containers.list(
                    all=True, filters=wanted, ignore_removed=True
                ):
                    made = datetime.fromisoformat(f"{container.attrs['Created'][:19]}+00:00")
                    if (datetime.now(timezone.utc) - made).total_seconds() > _NEVER_STARTED_S:
                        with contextlib.suppress(NotFound):  # another launcher may remove it, too
                            container.remove(force=True)
                return AgentContainer(
                    self._engine, self._address, node, image, 0 if self._is_rootless else _USER
                )
        except EnvironmentFault as fault:
            raise EnvironmentFault(f"{self.host}: {fault}") from fault

    def close(self) -> None:
        """Close the connection. Callable from any thread; idempotent."""
        self._held.close()

    def _tunnelled(self, ssh: Sequence[str]) -> str:
        """Open a tunnel to the engine's socket; returns the address of its end here."""
        where = urlsplit(self.host.docker)
        folder = Path(tempfile.mkdtemp(prefix="neuros-docker-"))  # names of sockets must be short
        self._held.callback(shutil.rmtree, folder, ignore_errors=True)
        socket, errors = folder / "socket", folder / "errors"
        destination = f"ssh://{where.netloc}"
        forward = f"{socket}:{where.path.rstrip('/') or _SOCKET}"
        # The remote command ends with its standard input, and so with this process in any case.
        remote = "echo ${SSH_CONNECTION:-}; exec cat >/dev/null"
        with open(errors, "w") as log:
            try:
                tunnel = subprocess.Popen(
                    [*ssh, *_FORWARDING, "-L", forward, "--", destination, remote],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=without_mark(os.environ),
                    start_new_session=True,
                    text=True,
                )
            except OSError as error:
                raise EnvironmentFault(f"ssh cannot be started ({error.strerror})") from error
        self._held.callback(tunnel.communicate)
        self._held.callback(tunnel.kill)
        assert tunnel.stdout is not None
        said = tunnel.stdout.readline()
        end_s = time.monotonic() + _CONNECT_S
        while said and not socket.is_socket() and time.monotonic() < end_s:
            time.sleep(_POLL_S)
        if not said or not socket.is_socket():
            last = (errors.read_text().strip().splitlines() or ["it does not say why"])[-1].strip()
            raise EnvironmentFault(f"ssh has no connection ({last})")
        self.reached_at = (said.split() or [""] * 4)[2]
        return f"unix://{socket}"

    def _image(self, container: str, project: Path, log: Log) -> Image:
        """The image of a container there; a better one of this machine is sent."""
        there: Image | None = None
        try:
            there = image_for(container, project, self._engine)
            if not there.notice:
                return there
        except EnvironmentFault as fault:
            why = fault
        try:
            with contextlib.closing(connect(timeout_s=None)) as engine:
                here = image_for(container, project, engine)
                if there is not None and here.notice:
                    return there
                with engine_faults(f"the image {here.name}"):
                    found = engine.images.get(here.id)
                    size = memory_text(int(found.attrs["Size"]))
                    log("INFO", f"{self.host.name} gets the image {here.name} ({size}), once")
                    self._engine.images.load(found.save(named=True))
                return here
        except EnvironmentFault:
            if there is not None:
                return there
        raise EnvironmentFault(f"{why}, here, or there with DOCKER_HOST={self.host.docker}")


class AgentContainer:
    """A container that :attr:`command` starts.

    Attributes:
        command: starts it, with its standard streams; it is removed at its end.
        description: its image and engine, ready for JSON.
    """

    def __init__(
        self, engine: DockerClient, address: str, node: Node, image: Image, user: int
    ) -> None:
        self._container = engine.containers.create(
            image.id,
            name=f"neuros-{node.name}-{os.urandom(4).hex()}",
            entrypoint=[*image.start, *python_command("neuros.cli", "agent", "--in-image")[1:]],
            command=[],
            environment={
                **DEFAULTS,
                "HOME": "/tmp",
                "USER": "neuros",
                "XDG_CACHE_HOME": str(_CACHE),
                "PYTHONPATH": str(LIBRARY),
            },
            working_dir="/tmp",
            labels={AGENT_LABEL: node.name},
            mounts=[{"Type": "volume", "Source": VOLUME, "Target": str(_CACHE)}],
            user=f"{user}:{user}",
            cap_drop=["ALL"],
            security_opt=["no-new-privileges"],
            init=True,
            network_mode=NETWORK_MODE,
            auto_remove=True,
            stdin_open=True,
            **limits(node),
        )
        try:
            here = {LIBRARY / name: folder for name, folder in libraries().items()}
            self._put(here, {_CACHE: user})
        except BaseException:
            self.close()
            raise
        self.command = ["docker", "--host", address, "start", "--attach", "--interactive"]
        self.command.append(self._container.id)
        self.description: Mapping[str, str] = {"image": image.name, "id": image.id}

    def put_messages(self, paths: Iterable[Path]) -> tuple[Path, ...]:
        """Copy built message packages into it; returns their folders on Python's path.

        Args:
            paths: their folders on Python's path here, ``<package>-<key>/python``.
        """
        found = {MESSAGES / path.parent.name: path.parent for path in paths}
        if found:
            with engine_faults("message packages"):
                self._put(found)
        return tuple(folder / "python" for folder in found)

    def close(self) -> None:
        """Remove the container. If its engine does not answer, it ends with its agent."""
        api = self._container.client.api
        api.timeout = min(api.timeout or _REMOVAL_S, _REMOVAL_S)
        try:
            self._container.remove(force=True)
        except DockerException:
            pass
        except requests.RequestException:
            api.timeout = _GONE_S  # do not wait as long for the next container of this engine

    def _put(self, trees: Mapping[Path, Path], owned: Mapping[Path, int] | None = None) -> None:
        """Copy folders into the container; make others, each with its owner."""
        archive = io.BytesIO()
        with tarfile.open(fileobj=archive, mode="w") as tar:
            for folder, user in (owned or {}).items():
                entry = tarfile.TarInfo(str(folder.relative_to("/")))
                entry.type, entry.mode, entry.uid, entry.gid = tarfile.DIRTYPE, 0o700, user, user
                tar.addfile(entry)
            for there, here in trees.items():
                tar.add(
                    here,
                    str(there.relative_to("/")),
                    filter=lambda each: None if "__pycache__" in each.name else for_all(each),
                )
        self._container.put_archive("/", archive.getvalue())
