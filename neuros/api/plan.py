"""Plan of a run: project and request, checked before the start, and their environments."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import socket
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from neuros.api.kept import Sources, find_sources, given_sources
from neuros.api.request import Duration, Request
from neuros.backends.guardian import Guardian
from neuros.backends.node_command import place, usable_cores, without_mark
from neuros.backends.portable import portable_project
from neuros.backends.process_launchers import VIRTUAL_ROS, WITHOUT_ROS
from neuros.backends.pythons import Pythons, require_one_python
from neuros.backends.run_processes import RUN_ID
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, Problem, ProjectError, UsageError, printable
from neuros.installation.progress import Progress, Stream
from neuros.messages.needed import Messages
from neuros.ports import BackEnd, Changes, Deployment, Launcher, NodeProgram, Notice
from neuros.project.model import Folders, Node, NodeFile, Project
from neuros.project.names import SESSION
from neuros.project.scanner import problem_in
from neuros.project.split import split
from neuros.project.validate import nest_conflicts
from neuros.registry import AUTO, BACK_ENDS, DEPLOYMENTS, Chosen, choose
from neuros.transport.dds_profile import (
    MOST_LOCAL_PARTICIPANTS,
    PEERS_VARIABLE,
    RANGE_VARIABLE,
    as_asked,
)

_HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")  # RFC 1123
_ON_MACHINES = "process"
"""The back end of all nodes of a deployment."""
_LISTS = 5  # lists of packets for each connection, at both ends: see neuros.node.logs
_LOOKS_LIKE_AN_ADDRESS = re.compile(r"[\d.]+")


@dataclass(frozen=True)
class Network:
    """Where nodes search for other nodes.

    Attributes:
        is_wide: whether on other machines, too.
        peers: IPv4 addresses of machines that multicast does not reach.
    """

    is_wide: bool = False
    peers: tuple[str, ...] = ()

    def environment(self, environ: Mapping[str, str]) -> dict[str, str]:
        """The variables of nodes; ``environ`` is that of the launcher."""
        if not self.is_wide:
            return {RANGE_VARIABLE: as_asked(environ).get(RANGE_VARIABLE) or "LOCALHOST"}
        peers = {PEERS_VARIABLE: ";".join(self.peers)} if self.peers else {}
        return {RANGE_VARIABLE: "SUBNET", **peers}


THIS_MACHINE = Network()


def chosen_network(network: bool, peers: str | None) -> Network:
    """The network that the options ask for.

    Raises:
        UsageError: if a peer is neither an IPv4 address nor a host name.
        EnvironmentFault: if a name is not known here.
    """
    if peers is None:
        return Network(network)
    addresses: dict[str, None] = {}
    for host in named_peers(peers):
        try:  # here, since the container of a node may not know the name
            found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
        except OSError as error:
            raise EnvironmentFault(
                f"--peers: the host '{host}' cannot be found from here ({error.strerror}): give its"
                " IPv4 address"
            ) from error
        addresses[str(found[0][4][0])] = None
    return Network(True, tuple(addresses))


def named_peers(peers: str) -> list[str]:
    """The addresses and names in a text of ``--peers``.

    Raises:
        UsageError: if one is neither an IPv4 address nor the name of a host.
    """
    wanted, nonsense = [part.strip() for part in peers.split(",")], []
    for part in wanted:
        is_possible = bool(_HOST_NAME.fullmatch(part))
        if _LOOKS_LIKE_AN_ADDRESS.fullmatch(part):
            try:
                address = ipaddress.IPv4Address(part)
                is_possible = not (address.is_unspecified or address.is_multicast)
            except ValueError:
                is_possible = False
        nonsense += [] if is_possible else [repr(part)]
    if nonsense:
        raise UsageError(
            f"--peers {peers}: {', '.join(nonsense)} is neither an IPv4 address nor the name of a"
            " host: give them as in --peers 10.0.0.7,robot.local"
        )
    return wanted


@dataclass(frozen=True)
class Plan:
    """A project, and which of its nodes to start, where, and how.

    Attributes:
        is_held: whether a session steps the run.
        restored: what nodes get back that their plugins have kept.
        fork: of which run it is a fork, for the record; empty: of none.
        changes: in virtual time, its seconds, and what changes there.
    """

    project: Project
    names: tuple[str, ...]
    chosen: Chosen
    request: Request
    pythons: Pythons = field(default_factory=lambda: Pythons({}))
    network: Network = THIS_MACHINE
    messages: Messages | None = None
    is_held: bool = False
    restored: Sources = field(default_factory=dict)
    fork: Mapping[str, Any] = field(default_factory=dict)
    changes: tuple[float, Changes] | None = None

    @property
    def provenance(self) -> dict[str, Any]:
        """What ``run.json`` says of the run of which this is a fork."""
        return {"fork": dict(self.fork)} if self.fork else {}

    @property
    def elsewhere(self) -> tuple[str, ...]:
        """The nodes that are not started: they may run elsewhere."""
        return tuple(node.name for node in self.project.nodes if node.name not in self.names)

    @property
    def nodes(self) -> list[Node]:
        return [self.project.node(name) for name in self.names]

    @property
    def back_end(self) -> BackEnd:
        """Where the nodes run."""
        return self.chosen.back_end

    @property
    def deployment(self) -> Deployment:
        """The back end, prepared for these nodes."""
        return self.chosen.deployment

    @property
    def places(self) -> Mapping[str, str]:
        """By node, its machine, if it is another one."""
        return self.deployment.places

    @property
    def notices(self) -> list[Notice]:
        """Notices for the user about the choice of the back end."""
        return [*self.chosen.notices, *self.deployment.notices]

    @property
    def is_partial(self) -> bool:
        return bool(self.elsewhere)

    @property
    def needs_known_domain(self) -> bool:
        """Whether other programs have to find the run, so that it cannot use any free domain."""
        nodes = self.project.nodes
        ports = (port for node in nodes for port in (*node.inputs, *node.outputs))
        topics = (port.external_topic for port in ports)
        has_external_topics = any(t is not None and not t.startswith(SESSION) for t in topics)
        is_named = bool(self.project.names.namespace)  # a namespace separates runs in one domain
        # The machines of a deployment get the domain from this launcher.
        is_open = self.is_partial or (self.network.is_wide and not self.places)
        return is_open or has_external_topics or is_named

    def node_files(self, folders: Folders) -> list[NodeFile]:
        """The content of ``node.json`` of each node to start."""
        files = split(self.project, lambda _: folders)
        paths = self.messages.paths if self.messages else ()
        lists = _LISTS * max(1, len(self.project.connections))
        list_bytes = self.request.packet_log_bytes // lists
        restored = {
            node: {name: str(file) for name, file in values.items()}
            for node, values in self.restored.items()
        }
        return [
            replace(
                f, messages=paths, list_bytes=list_bytes, restored=restored.get(f.node.name, {})
            )
            for f in files
            if f.node.name in self.names
        ]

    def launcher(self, guardian: Guardian | None = None) -> Launcher:
        """The launcher of the back end; it reports its processes to ``guardian``."""
        transport = self.deployment.transport or self.back_end.transport
        end, is_virtual = self.request.end, self.project.is_virtual
        if is_virtual:
            transport = WITHOUT_ROS if self.back_end.is_one_process else VIRTUAL_ROS
        options = ["--transport", transport]
        if is_virtual and end.wall_s is not None:
            options += ["--duration", repr(end.wall_s)]
        if self.request.real_time_factor is not None:
            options += ["--real-time-factor", repr(self.request.real_time_factor)]
        if self.changes is not None:
            options += ["--fork", json.dumps(self.changes)]
        if self.back_end.is_one_process:
            options.append("--one-process")
        if end.sim_s is not None:
            options += ["--duration-sim", repr(end.sim_s)]
        if self.request.verbose:
            options.append("--debug")
        if self.request.digests and self.back_end.is_one_process:  # others always keep them
            options.append("--digests")
        if self.request.recording is not None:
            options.append("--record")
        if self.is_held:
            options.append("--held")
        return self.deployment.launcher(
            NodeProgram(
                options,
                place(self.nodes) if self.request.placement else {},
                self.pythons.paths,
                guardian,
                as_asked(os.environ),
                self.request.isolate,
            )
        )


def make_plan(
    project: Project, messages: Messages, request: Request, *, is_tried: bool = True
) -> Plan:
    """Plan a run; with a deployment, reach its machines and prepare them.

    Args:
        messages: the message packages of the project.
        is_tried: whether the plan is to run; else it is only described, and machines are not asked.

    Raises:
        UsageError, ProjectError, EnvironmentFault: if the request cannot be run.
    """
    try:
        str(project.folder).encode()  # a plugin that logs gives ROS the path of its file
    except UnicodeEncodeError:
        text = f"{project.folder}: the name is not UTF-8, as ROS needs it: rename it"
        raise UsageError(text) from None
    if project.is_portable if request.portable is None else request.portable:
        project = portable_project(project, os.environ)
    else:
        project = replace(project, is_portable=False)
    network = chosen_network(request.network, request.peers)
    known = [node.name for node in project.nodes]
    for name in request.nodes:
        if name not in known:
            raise UsageError(f"-n {name}: no such node; the project has {', '.join(known)}")
    names = tuple(name for name in known if not request.nodes or name in request.nodes)
    restored = find_sources(given_sources(request.restore), names)
    nodes = [project.node(name) for name in names]
    if request.deployment is None:
        chosen = choose(request.backend or AUTO, project, nodes, request.backend_options or {})
    else:
        chosen = _choose_machines(project, Path(request.deployment), request)
        nodes = [node for node in nodes if node.name not in chosen.deployment.places]
        network = Network(bool(chosen.deployment.places))
    back_end = chosen.back_end
    has_pythons = not (back_end.is_one_process or back_end.has_own_pythons)
    pythons = Pythons.choose(nodes if has_pythons else [], project.folder, os.environ)
    plan = Plan(project, names, chosen, request, pythons, network, messages, restored=restored)
    _check_places(plan)
    conflicts = nest_conflicts(project, names) if back_end.is_one_process else ()
    if problems := [*conflicts, *time_problems(project, plan.nodes, request.end)]:
        raise ProjectError(problems)
    if is_tried:
        check_machine(plan, os.environ)

        def show(severity: str, text: str) -> None:  # there is no console yet
            mark = "" if severity == "INFO" else "warning: "
            print(f"neuros: {mark}{printable(text)}", file=sys.stderr, flush=True)

        peers = (*network.peers, *plan.deployment.connect(show))
        plan = replace(plan, network=replace(network, peers=peers))
    return plan


def _choose_machines(project: Project, file: Path, request: Request) -> Chosen:
    """Prepare a deployment: its file tells where nodes run, and how they reach each other."""
    others = {
        "-n": request.nodes,
        "--network": request.network,
        "--peers": request.peers,
        "--isolate": request.isolate,
        "--backend": request.backend not in (None, AUTO, _ON_MACHINES),
    }
    if given := [option for option, value in others.items() if value]:
        raise UsageError(
            f"--deployment with {', '.join(given)}: the deployment file says where nodes run (in"
            " processes) and how they reach each other; leave that out"
        )
    options = request.backend_options or {}
    deployment = DEPLOYMENTS.load("machines").prepare(
        file,
        project,
        lambda here: choose(_ON_MACHINES, project, here, options).deployment,
        monitors_load=request.monitor_system_load,
    )
    return Chosen(BACK_ENDS.load(_ON_MACHINES), deployment)


def check_machine(plan: Plan, environ: Mapping[str, str]) -> None:
    """Check that this machine can run the plan.

    Raises:
        EnvironmentFault: if ROS is missing, or cannot connect so many processes, or a node asks
            for a core that is missing, or nodes of one process need several Pythons.
    """
    if find_spec("rclpy") is None:
        raise EnvironmentFault(
            f"rclpy, the Python library of ROS 2, is not installed for {sys.executable}:"
            f" {install_command()}"
        )
    usable = usable_cores()
    # A project may have been written for another machine: its cores are no mistake in it.
    problems = [
        f"{problem_in(node.file, f'{node.pointer}/affinity', text)}"
        for node in plan.nodes
        if node.name not in plan.places
        if plan.request.placement and (missing := set(node.affinity) - usable)
        for text in [f"node '{node.name}' asks for {_cores_in_words(missing)}"]
    ]
    if problems:
        problems.append(
            f"NeuROS may use {_cores_in_words(usable)} here: choose others with --set"
            " nodes.NAME.affinity=[...], or leave it to the kernel with --no-placement"
        )
        raise EnvironmentFault("\n".join(problems))
    is_one_process = plan.back_end.is_one_process
    if is_one_process:
        require_one_python(plan.nodes, plan.project.folder, environ)
    is_local = plan.network.environment(environ)[RANGE_VARIABLE] == "LOCALHOST"
    if not is_one_process and is_local and len(plan.names) > MOST_LOCAL_PARTICIPANTS:
        raise EnvironmentFault(
            f"{len(plan.names)} processes cannot all find each other: with discovery on this"
            f" machine only, {MOST_LOCAL_PARTICIPANTS} can: use --backend in-process, or --network"
        )


def _cores_in_words(cores: Collection[int]) -> str:
    return f"core{'s' if len(cores) > 1 else ''} {', '.join(map(str, sorted(cores)))}"


def _check_places(plan: Plan) -> None:
    """Refuse nodes elsewhere that this run cannot reach: by memory, isolated, in virtual time."""
    back_end, request, nodes = plan.back_end, plan.request, plan.project.nodes
    elsewhere = "--network" if plan.network.is_wide else "-n" if plan.is_partial else ""
    if back_end.is_one_process:
        for connection in plan.project.connections:
            ends = {connection.source_node, connection.destination_node}
            if len(ends) == 2 and len(ends.intersection(plan.names)) == 1:
                raise UsageError(
                    f"-n leaves out one end of {connection}, which the {back_end.name} back end"
                    " cannot reach; use --backend docker or process"
                )
        if plan.network.is_wide and plan.is_partial:
            raise UsageError(
                f"--network with -n: the nodes of the {back_end.name} back end cannot reach nodes"
                " elsewhere; use --backend process"
            )
    if request.isolate and elsewhere:
        raise UsageError(f"--isolate with {elsewhere}: nodes elsewhere cannot reach the run")
    sent = {None, *(port.external_topic for node in nodes for port in node.outputs)}
    unreachable = [
        f"{node.name}.{port.name} ({port.external_topic})"
        for node in nodes
        for port in node.inputs
        if port.external_topic not in sent
    ]
    if request.isolate and unreachable:
        raise UsageError(
            f"--isolate: other programs cannot reach the external inputs"
            f" {', '.join(unreachable)}; leave --isolate out, or connect them"
        )
    if plan.project.is_virtual and elsewhere:
        raise UsageError(f"{elsewhere}: nodes elsewhere are in real time: leave out --time virtual")
    if request.real_time_factor is not None and not plan.project.is_virtual:
        raise UsageError(
            "--real-time-factor: it is the pace of virtual time: add --time virtual; the machine"
            " sets that of real time"
        )


def time_problems(project: Project, nodes: Sequence[Node], end: Duration) -> Sequence[Problem]:
    """The problem of a duration in simulated time, unless exactly one node owns time."""
    if end.sim_s is None:
        return ()
    owners = [node.name for node in nodes if node.owns_time]
    if len(owners) == 1:
        return ()
    return [
        Problem(
            str(project.file),
            1,
            1,
            "/nodes",
            "--duration in simulated time needs exactly one node that owns time:"
            f" {', '.join(owners) or 'none'}",
            "a node owns time if a port of it has mujoco, or its output is a Clock",
        )
    ]


def make_environments(pythons: Pythons, messages: Messages | None, output: Stream) -> None:
    """Make missing environments and message packages; ``KeyboardInterrupt`` ends it at any time.

    Args:
        output: shows the progress.

    Raises:
        EnvironmentFault: with all failures.
    """
    pythons.record_use()
    if messages is not None:
        messages.record_use()
    if are_made(pythons, messages):
        return
    # The guardian ends pip, the compiler, and their children when the launcher is killed.
    run_id = os.urandom(8).hex()
    guardian = Guardian.start(run_id)
    guardian.await_ready()
    try:
        progress = Progress(output)
        if messages is not None:
            messages.make(progress, {**without_mark(os.environ), RUN_ID: run_id})
        pythons.make(progress, {RUN_ID: run_id})
    finally:
        guardian.finish()


def are_made(pythons: Pythons, messages: Messages | None) -> bool:
    return pythons.is_made and (messages is None or messages.is_made)
