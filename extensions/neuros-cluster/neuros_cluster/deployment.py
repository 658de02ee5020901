"""A back end whose nodes are on several machines, according to a deployment file.

Nodes of this machine are the back end's own; agents run the others. To the supervisor all look
alike: they report over the control channel, and their files are in the run folder.
"""

from __future__ import annotations

import contextlib
import json
import re
import socket
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.backends.control_sockets import connect
from neuros.backends.node_command import moved
from neuros.control import CONTROL_VARIABLE
from neuros.distribution import WORKSPACE
from neuros.errors import EnvironmentFault, results_of
from neuros.node.keeping import RESTORED, SUFFIX
from neuros.ports import (
    Deployment,
    DeploymentKind,
    Finding,
    FindingState,
    Launcher,
    NodeProgram,
    RunningNode,
)
from neuros.project.model import Folders, Node, NodeFile, Project
from neuros.project.split import node_file_to_json, split, translated
from neuros.registry import BACK_ENDS
from neuros.stacks import ProcessThreads
from neuros_cluster.deployment_file import HERE, DeploymentFile, Host, load_deployment
from neuros_cluster.machine import Log, Machine, agent_command, ssh_command
from neuros_cluster.messages import Finished, Ready, Start

if TYPE_CHECKING:
    from neuros_cluster.remote_engine import AgentContainer, RemoteEngine

_PEERS = "ROS_STATIC_PEERS"
_ANY_PORT = 9
_MUCH_S = 0.1  # a larger difference of clocks causes a warning


@dataclass
class Side:
    """A machine of a deployment, connected and prepared.

    Attributes:
        nodes: the nodes that it runs.
        address: its address for others; ``here``: the address of this machine for it.
        messages: folders of the message packages that were built there.
        sent: number of files that were sent.
        container: the container of its node, where the machine is a Docker engine.
    """

    machine: Machine
    nodes: tuple[str, ...]
    ready: Ready
    address: str = ""
    here: str = ""
    messages: tuple[Path, ...] = ()
    sent: int = 0
    left: Finished | None = None
    container: AgentContainer | None = None

    @property
    def host(self) -> Host:
        return self.machine.host

    def described(self) -> str:
        """A line about the machine."""
        ready, clock = self.ready, self.machine.clock
        return (
            f"{self.host.way}: {ready.machine}, Python"
            f" {ready.python}, NeuROS {ready.version}, at {self.address}; round trip"
            f" {1e3 * clock.round_trip_s:.1f} ms, clock {clock.unix_s:+.3f} s"
        )


class Machines(Deployment):
    """Nodes on several machines.

    Args:
        file: the deployment.
        inner: starts the nodes of this machine.
        monitors_load: whether the other machines write their system load.
    """

    def __init__(
        self,
        file: DeploymentFile,
        project: Project,
        inner: Deployment,
        *,
        monitors_load: bool = False,
    ) -> None:
        self.file = file
        self.monitors_load = monitors_load
        self.sides: list[Side] = []
        self._held: list[Machine | AgentContainer | RemoteEngine] = []
        self.project = project
        self.notices = inner.notices
        self.places = file.places
        self._inner = inner

    def connect(self, log: Log) -> Sequence[str]:
        """Connect to all machines and prepare them, in parallel; returns their addresses."""
        hosts = self.file.used
        with ThreadPoolExecutor(max(1, len(hosts)), "neuros-machines") as threads:
            work = [threads.submit(self._sides_of, host, log) for host in hosts]
            try:
                wait(work)
            except BaseException:  # Ctrl+C
                self._close_all()
                raise
        sides, failed = results_of(work)
        self.sides = [side for of_host in sides for side in of_host]
        if failed is not None:
            self.close()
            raise failed
        for side in self.sides:
            clock = side.machine.clock
            ahead_s = clock.unix_s
            if abs(ahead_s) > _MUCH_S + clock.round_trip_s / 2:
                log(
                    "WARN",
                    f"the clock of {side.host.name} is {abs(ahead_s):.1f} s"
                    f" {'ahead of' if ahead_s > 0 else 'behind'} that of this machine, and so are"
                    " the times in its logs and recordings: set it (chrony, systemd-timesyncd)",
                )
        return [*dict.fromkeys(side.address for side in self.sides)]

    def close(self) -> None:
        """Close all connections; the agents end what is left."""
        self._close_all()
        self.sides = []

    def _close_all(self) -> None:
        # In reverse order: an engine after its containers.
        while self._held:
            self._held.pop().close()

    def launcher(self, program: NodeProgram) -> Launcher:
        return _Launcher(self, self._inner.launcher(program), program)

    def logs(self, run_folder: Path) -> Mapping[str, Path]:
        return self._inner.logs(run_folder)

    def as_here(self, text: str, folders: Folders) -> str:
        for side in self.sides:
            for name, there in vars(side.machine.folders).items():
                text = _renamed(text, str(there), str(getattr(folders, name)))
        return self._inner.as_here(text, folders)

    def record(self) -> Mapping[str, Any]:
        return {
            **self._inner.record(),
            "deployment": str(self.file.file),
            "machines": {side.host.name: _record(side) for side in self.sides},
        }

    def finish(self, is_enough: Callable[[], bool]) -> Sequence[str]:
        faults = [*self._inner.finish(is_enough)]
        if not self.sides:
            return faults
        with ThreadPoolExecutor(len(self.sides), "neuros-machines") as threads:
            for found in threads.map(lambda side: _bring_home(side, is_enough), self.sides):
                faults += found
        self._close_all()
        return faults

    def node_there(self, file: NodeFile, side: Side) -> NodeFile:
        there = side.machine.folders
        built = {_package(python): python.parent for python in side.messages}
        pairs = [
            (file.folders.project, there.project),
            (file.folders.workspace, there.workspace),
            *(
                (python.parent, built[_package(python)])
                for python in file.messages
                if _package(python) in built
            ),
        ]
        node = translated(file.node, lambda path: moved(path, pairs))
        return replace(file, node=node, folders=there, messages=side.messages)

    def _sides_of(self, host: Host, log: Log) -> Sequence[Side]:
        """One side for all nodes of a host; with containers, one for each node."""
        names = tuple(node for node, place in self.places.items() if place == host.name)
        if not host.docker:
            return [self._side(host, names, log)]
        # The Docker SDK is slow to import.
        from neuros_cluster.remote_engine import RemoteEngine

        engine = RemoteEngine(host, ssh_command(host))
        self._held.append(engine)
        sides: list[Side] = []
        for name in names:
            container = engine.container(self.project.node(name), self.project.folder, log)
            self._held.append(container)
            own = host if len(names) == 1 else replace(host, name=f"{host.name}-{name}")
            sides.append(self._side(own, (name,), log, engine, container))
        return sides

    def _side(
        self,
        host: Host,
        names: tuple[str, ...],
        log: Log,
        engine: RemoteEngine | None = None,
        container: AgentContainer | None = None,
    ) -> Side:
        command = container.command if container else agent_command(host)
        machine = Machine(host, self.file.timeout_s, log, command)
        self._held.append(machine)
        ready = machine.greet()
        side = Side(machine, names, ready, container=container)
        side.address = _address(host, ready, engine.reached_at if engine else ready.reached_at)
        side.here = _own_address(self.file.here, side.address)
        side.sent = machine.place(self.project.folder)
        folders = Folders(self.project.folder, WORKSPACE, Path())
        files = [f for f in split(self.project, lambda _: folders) if f.node.name in names]
        described = [node_file_to_json(self.node_there(file, side)) for file in files]
        side.messages = machine.prepare(described)
        return side


class _Launcher:
    """Starts each node on its machine (:class:`neuros.ports.Launcher`)."""

    def __init__(self, machines: Machines, inner: Launcher, program: NodeProgram) -> None:
        self._machines = machines
        self._inner = inner
        self._program = program

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningNode]:
        places, sides = self._machines.places, self._machines.sides
        try:
            for side in sides:
                self._begin(side, nodes, environment)
            for side in sides:
                side.machine.await_started()
            here = [file for file in nodes if file.node.name not in places]
            started = [*self._inner.start(here, environment)]
        except BaseException:
            self._machines.close()
            raise
        return [*started, *(NodeElsewhere(side, name) for side in sides for name in side.nodes)]

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        places, hosts = self._machines.places, self._machines.file.hosts
        here = [file for file in nodes if file.node.name not in places]
        elsewhere = [file.node.name for file in nodes if file.node.name in places]
        return [
            *self._inner.describe(here),
            *(
                f"{'container' if hosts[places[name]].docker else 'process'} {name} on"
                f" {hosts[places[name]]}"
                for name in elsewhere
            ),
        ]

    def _begin(self, side: Side, nodes: Sequence[NodeFile], environment: Mapping[str, str]) -> None:
        run = nodes[0].folders.run
        files = [file for file in nodes if file.node.name in side.nodes]
        if side.container:  # the packages are built by now
            side.messages = side.container.put_messages(files[0].messages)
        others = [side.here, *(each.address for each in self._machines.sides if each is not side)]
        if self._program.guardian:
            self._program.guardian.watch(side.machine.pid)
        side.machine.begin(
            Start(
                environment["NEUROS_RUN_ID"],
                self._machines.project.name,
                side.host.name,
                tuple(node_file_to_json(self._machines.node_there(f, side)) for f in files),
                {**environment, _PEERS: ";".join(dict.fromkeys(others))},
                tuple(self._program.options),
                {name: c for name, c in self._program.cores.items() if name in side.nodes},
                self._machines.monitors_load,
            ),
            run,
            [
                *run.glob("*.json"),
                *(
                    run / file.node.name / RESTORED / f"{name}{SUFFIX}"
                    for file in files
                    for name in file.restored
                ),
            ],
            lambda: connect(environment[CONTROL_VARIABLE]),
        )


@dataclass
class NodeElsewhere:
    """A node on another machine (:class:`neuros.ports.RunningNode`)."""

    side: Side
    name: str

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name,)

    def poll(self) -> str | None:
        return self.side.machine.end_of(self.name)

    @property
    def is_abandoned(self) -> bool:
        return bool(self.side.machine.lost)

    def kill(self) -> None:
        self.side.machine.kill(self.name)

    def threads(self) -> ProcessThreads:
        return self.side.machine.threads_of(self.name)


def _bring_home(side: Side, is_enough: Callable[[], bool]) -> Sequence[str]:
    """Copy the files of the nodes to this machine; returns problems."""
    machine, was_lost = side.machine, bool(side.machine.lost)
    side.left = machine.finish(is_enough)
    machine.move_times(side.nodes)
    faults = [machine.fault] if machine.fault else []
    if side.left is not None:
        faults += [f"{side.host.name}: {problem}" for problem in side.left.problems]
    elif not was_lost:
        why = f": {machine.lost}" if machine.lost else ""
        faults.append(
            f"not all files of nodes on {side.host.name} were copied to this machine{why}"
        )
    return faults


def _renamed(text: str, there: str, here: str) -> str:
    """Replace a path there by the one here, except after a colon (``host:path``)."""
    return re.sub(rf"(?<![\w/.:]){re.escape(there)}\b", lambda _: here, text)


def _package(python: Path) -> str:
    """The message package of a folder for Python's path, ``<package>-<key>/python``."""
    return python.parent.name.rpartition("-")[0]


def _record(side: Side) -> dict[str, Any]:
    clock = side.machine.clock
    load = None if side.left is None else side.left.load
    return {
        "reached_by": side.host.way,
        **({"container": side.container.description} if side.container else {}),
        "name": side.ready.name,
        "address": side.address,
        "nodes": list(side.nodes),
        "python": side.ready.python,
        "architecture": side.ready.machine,
        "files_sent": side.sent,
        "clock_ahead_s": clock.unix_s if clock.is_known else None,
        "round_trip_s": clock.round_trip_s if clock.is_known else None,
        "lost": side.machine.lost,
        "system_load": load,
    }


def _address(host: Host, ready: Ready, reached_at: str) -> str:
    """The IPv4 address of a machine for other machines. Raises ``EnvironmentFault``."""
    known = host.address or ("" if host.through else reached_at)
    for name in (known, ready.name):
        with contextlib.suppress(OSError):
            if name:
                found = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_DGRAM)
                return str(found[0][4][0])
    raise EnvironmentFault(
        f"{host}: it is not known at which address nodes reach it ('{known or ready.name}' has no"
        f" IPv4 address here): give one in /hosts/{host.name}/address"
    )


def _own_address(here: Host, address: str) -> str:
    """The IPv4 address of this machine for the machine at an address."""
    if here.address:
        return _address(here, Ready("", "", "", ""), "")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, _ANY_PORT))  # sends nothing: the kernel chooses the route
        except OSError as error:
            raise EnvironmentFault(
                f"this machine cannot reach {address} ({error.strerror}), the address of its nodes"
            ) from error
        return str(probe.getsockname()[0])


class _Machines(DeploymentKind):
    name = "machines"

    def prepare(
        self,
        file: Path,
        project: Project,
        here: Callable[[Sequence[Node]], Deployment],
        *,
        monitors_load: bool,
    ) -> Deployment:
        found = load_deployment(file, project)
        inner = here([node for node in project.nodes if node.name not in found.places])
        return Machines(found, project, inner, monitors_load=monitors_load)

    def checks(self, file: Path, *, proves: bool) -> Iterator[Finding]:
        from neuros.api.loading import load_with_messages
        from neuros.doctor.checks import PROJECT

        project = load_with_messages(PROJECT)[0].project
        found = load_deployment(file)
        inner = BACK_ENDS.load("process").prepare(project, (), {})
        for host in found.hosts.values():
            machines = Machines(replace(found, places={"eye": host.name}), project, inner)
            try:
                machines.connect(lambda severity, text: None)
                (side,) = machines.sides
                yield Finding.good(host.name, side.described())
                for state, subject, text, remedy in side.machine.examine():
                    yield Finding(FindingState(state), f"{host.name}: {subject}", text, remedy)
            except EnvironmentFault as fault:
                yield Finding.bad(host.name, str(fault))
                continue
            finally:
                machines.close()
            if proves:
                yield _prove_between(file, host.name)


def _prove_between(path: Path, host: str) -> Finding:
    """Prove delivery between this machine and another one of a deployment file."""
    from neuros.doctor.checks import prove_delivery

    hosts = json.loads(path.read_text("utf-8"))["hosts"]
    used = {name: keys for name, keys in hosts.items() if name in (host, HERE)}
    with tempfile.TemporaryDirectory(prefix="neuros-doctor-") as folder:
        alone = Path(folder) / "deployment.json"
        alone.write_text(json.dumps({"hosts": used, "nodes": {"eye": host}}), "utf-8")
        return prove_delivery("process", options=("--deployment", str(alone)), where=host)


MACHINES = _Machines()
