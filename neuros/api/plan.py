"""Plan of a run: project and request, checked before the start, and the environments they need."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

from neuros.api.request import Duration, Request
from neuros.backends.node_command import place, usable_cores, without_mark
from neuros.backends.pythons import Pythons, require_one_python
from neuros.backends.reaper import Reaper
from neuros.backends.run_processes import RUN_ID
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, Problem, ProjectError, UsageError, printable
from neuros.installation.progress import Progress, Stream
from neuros.messages.needed import Messages
from neuros.ports import BackEnd, Deployment, Launcher, NodeProgram, Notice
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
"""The back end of nodes on other machines, and of all nodes of a deployment."""
_LISTS = 5  # of packets for each connection, at both ends: see neuros.node.logs
_LOOKS_LIKE_AN_ADDRESS = re.compile(r"[\d.]+")


@dataclass(frozen=True)
class Network:
    """How far nodes look for others.

    Attributes:
        is_wide: whether beyond this machine.
        peers: IPv4 addresses of machines that multicast does not reach.
    """

    is_wide: bool = False
    peers: tuple[str, ...] = ()

    def environment(self, environ: Mapping[str, str]) -> dict[str, str]:
        """What the nodes get; without a wish, what the launcher's own environment says."""
        if not self.is_wide:
            return {RANGE_VARIABLE: as_asked(environ).get(RANGE_VARIABLE) or "LOCALHOST"}
        peers = {PEERS_VARIABLE: ";".join(self.peers)} if self.peers else {}
        return {RANGE_VARIABLE: "SUBNET", **peers}


THIS_MACHINE = Network()


def chosen_network(network: bool, peers: str | None) -> Network:
    """What the options say.

    Raises:
        UsageError: if a peer is neither an IPv4 address nor a host name.
        EnvironmentFault: if a name is not known here.
    """
    if peers is None:
        return Network(network)
    return Network(True, tuple(dict.fromkeys(map(_address, named_peers(peers)))))


def named_peers(peers: str) -> list[str]:
    """The addresses and names in a text of ``--peers``.

    Raises:
        UsageError: if one can be neither.
    """
    wanted = [part.strip() for part in peers.split(",")]
    nonsense = [part for part in wanted if not _is_possible(part)]
    if nonsense:
        raise UsageError(
            f"--peers {peers}: {', '.join(map(repr, nonsense))} is neither an IPv4 address nor the"
            " name of a host: give them as in --peers 10.0.0.7,robot.local"
        )
    return wanted


def _is_possible(text: str) -> bool:
    if _LOOKS_LIKE_AN_ADDRESS.fullmatch(text):
        try:
            address = ipaddress.IPv4Address(text)
        except ValueError:
            return False
        return not (address.is_unspecified or address.is_multicast)
    return _HOST_NAME.fullmatch(text) is not None


def _address(host: str) -> str:
    """The IPv4 address of a host: found here, since a node's container may not know the name."""
    try:
        found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    except OSError as error:
        raise EnvironmentFault(
            f"--peers: the host '{host}' cannot be found from here ({error.strerror}): give its"
            " IPv4 address"
        ) from error
    return str(found[0][4][0])


@dataclass(frozen=True)
class Plan:
    """A project, which of its nodes to start, where, and how.

    Attributes:
        is_held: for a session.
    """

    project: Project
    names: tuple[str, ...]
    chosen: Chosen
    request: Request
    pythons: Pythons = field(default_factory=lambda: Pythons({}))
    network: Network = THIS_MACHINE
    messages: Messages | None = None
    is_held: bool = False

    @property
    def elsewhere(self) -> tuple[str, ...]:
        """The nodes that are left out: they may be running elsewhere."""
        return tuple(node.name for node in self.project.nodes if node.name not in self.names)

    @property
    def nodes(self) -> list[Node]:
        """The nodes that are to be started."""
        return [self.project.node(name) for name in self.names]

    @property
    def back_end(self) -> BackEnd:
        """Where they run."""
        return self.chosen.back_end

    @property
    def deployment(self) -> Deployment:
        """The back end made ready for them."""
        return self.chosen.deployment

    @property
    def places(self) -> Mapping[str, str]:
        """The machine of each node that does not run on this one."""
        return self.deployment.places

    @property
    def notices(self) -> list[Notice]:
        """What the user should know of the choice."""
        return [*self.chosen.notices, *self.deployment.notices]

    @property
    def nodes_here(self) -> list[Node]:
        """The nodes that are to be started on this machine."""
        return [node for node in self.nodes if node.name not in self.places]

    @property
    def is_partial(self) -> bool:
        """Whether there are such nodes."""
        return bool(self.elsewhere)

    @property
    def needs_known_domain(self) -> bool:
        """Whether others have to find this run, so that it cannot hide in a domain of its own."""
        nodes = self.project.nodes
        ports = (port for node in nodes for port in (*node.inputs, *node.outputs))
        topics = (port.external_topic for port in ports)
        has_external_topics = any(t is not None and not t.startswith(SESSION) for t in topics)
        is_named = bool(self.project.names.namespace)  # who wants one is among others
        # A launcher tells the domain to all machines of its deployment.
        is_open = self.is_partial or (self.network.is_wide and not self.places)
        return is_open or has_external_topics or is_named

    def node_files(self, folders: Folders) -> list[NodeFile]:
        """One ``node.json`` per node that is to be started."""
        files = split(self.project, lambda _: folders)
        paths = self.messages.paths if self.messages else ()
        lists = _LISTS * max(1, len(self.project.connections))
        list_bytes = self.request.packet_log_bytes // lists
        return [
            replace(f, messages=paths, list_bytes=list_bytes)
            for f in files
            if f.node.name in self.names
        ]

    def launcher(self, reaper: Reaper | None = None) -> Launcher:
        """The launcher of the back end; ``reaper`` hears of all it starts."""
        options = ["--transport", self.back_end.transport]
        if self.back_end.is_one_process:
            options.append("--one-process")
        if self.request.end.sim_s is not None:
            options += ["--duration-sim", repr(self.request.end.sim_s)]
        if self.request.verbose:
            options.append("--debug")
        if self.request.digests and self.back_end.is_one_process:  # elsewhere always kept
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
                reaper,
                as_asked(os.environ),
                self.request.isolate,
            )
        )


def make_plan(
    project: Project, messages: Messages, request: Request, *, is_tried: bool = True
) -> Plan:
    """Put together what is asked for; with a deployment, reach its machines and prepare them.

    Args:
        messages: the message packages of the project.
        is_tried: whether it is to run, or only to be described.

    Raises:
        UsageError, ProjectError, EnvironmentFault: if that cannot be run.
    """
    _check_folder(project.folder)
    network = chosen_network(request.network, request.peers)
    names = _chosen_names(project, request.nodes)
    nodes = [project.node(name) for name in names]
    if request.deployment is None:
        chosen = choose(request.backend or AUTO, project, nodes, request.backend_options or {})
    else:
        chosen = _choose_machines(project, Path(request.deployment), request)
        nodes = [node for node in nodes if node.name not in chosen.deployment.places]
        network = Network(bool(chosen.deployment.places))
    back_end = chosen.back_end
    if back_end.is_one_process:
        _check_reach(project, names, back_end)
    has_pythons = not (back_end.is_one_process or back_end.has_own_pythons)
    pythons = Pythons.choose(nodes if has_pythons else [], project.folder, os.environ)
    plan = Plan(project, names, chosen, request, pythons, network, messages)
    if back_end.is_one_process and network.is_wide and plan.is_partial:
        raise UsageError(
            f"--network with -n: the nodes of the {back_end.name} back end cannot reach nodes"
            " elsewhere; use --backend process"
        )
    if request.isolate:
        _check_isolation(plan)
    conflicts = nest_conflicts(project, names) if back_end.is_one_process else ()
    if problems := [*conflicts, *time_problems(project, plan.nodes, request.end)]:
        raise ProjectError(problems)
    if is_tried:
        check_machine(plan, os.environ)
        peers = (*network.peers, *plan.deployment.connect(_say))
        plan = replace(plan, network=replace(network, peers=peers))
    return plan


def _choose_machines(project: Project, file: Path, request: Request) -> Chosen:
    """A deployment says itself where nodes run, and how these reach each other."""
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


def _say(severity: str, text: str) -> None:
    """What is going on on other machines, before there is a console."""
    mark = "" if severity == "INFO" else "warning: "
    print(f"neuros: {mark}{printable(text)}", file=sys.stderr, flush=True)


def _check_folder(folder: Path) -> None:
    """Refuse a name that is no text: a plugin that logs gives ROS the path of its file."""
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise UsageError(f"{folder}: the name is not UTF-8, as ROS needs it: rename it") from None


def check_machine(plan: Plan, environ: Mapping[str, str]) -> None:
    """Check that this machine can run the plan.

    Raises:
        EnvironmentFault: if ROS is missing, or cannot join so many processes, or a node asks for
            a core that is not there, or one Python has to do and does not.
    """
    if find_spec("rclpy") is None:
        raise EnvironmentFault(
            f"rclpy, the Python library of ROS 2, is not installed for {sys.executable}:"
            f" {install_command()}"
        )
    if plan.request.placement:
        _check_cores(plan)
    is_one_process = plan.back_end.is_one_process
    if is_one_process:
        require_one_python(plan.nodes, plan.project.folder, environ)
    is_local = plan.network.environment(environ)[RANGE_VARIABLE] == "LOCALHOST"
    if not is_one_process and is_local and len(plan.names) > MOST_LOCAL_PARTICIPANTS:
        raise EnvironmentFault(
            f"{len(plan.names)} processes cannot all find each other: with discovery on this"
            f" machine only, {MOST_LOCAL_PARTICIPANTS} can: use --backend in-process, or --network"
        )


def _check_cores(plan: Plan) -> None:
    """A project may have been written for another machine: its cores are no mistake in it."""
    usable = usable_cores()
    problems = [
        str(
            problem_in(
                node.file,
                f"{node.pointer}/affinity",
                f"node '{node.name}' asks for {_cores_in_words(missing)}",
            )
        )
        for node in plan.nodes_here
        if (missing := set(node.affinity) - usable)
    ]
    if problems:
        problems.append(
            f"NeuROS may use {_cores_in_words(usable)} here: choose others with --set"
            " nodes.NAME.affinity=[...], or leave it to the kernel with --no-placement"
        )
        raise EnvironmentFault("\n".join(problems))


def _cores_in_words(cores: Collection[int]) -> str:
    return f"core{'s' if len(cores) > 1 else ''} {', '.join(map(str, sorted(cores)))}"


def _chosen_names(project: Project, wanted: Sequence[str]) -> tuple[str, ...]:
    known = [node.name for node in project.nodes]
    for name in wanted:
        if name not in known:
            raise UsageError(f"-n {name}: no such node; the project has {', '.join(known)}")
    return tuple(name for name in known if not wanted or name in wanted)


def _check_reach(project: Project, chosen: Collection[str], back_end: BackEnd) -> None:
    """Nodes that hand packets over in memory reach none elsewhere."""
    for connection in project.connections:
        ends = {connection.source_node, connection.destination_node}
        if len(ends) == 2 and len(ends.intersection(chosen)) == 1:
            raise UsageError(
                f"-n leaves out one end of {connection}, which the {back_end.name} back end"
                " cannot reach; use --backend docker or process"
            )


def _check_isolation(plan: Plan) -> None:
    """A run in a network of its own reaches nothing outside."""
    if plan.network.is_wide or plan.is_partial:
        option = "--network" if plan.network.is_wide else "-n"
        raise UsageError(f"--isolate with {option}: nodes elsewhere cannot reach the run")
    nodes = plan.project.nodes
    sent = {port.external_topic for node in nodes for port in node.outputs}
    heard = [
        f"{node.name}.{port.name} ({port.external_topic})"
        for node in nodes
        for port in node.inputs
        if port.external_topic not in sent | {None}
    ]
    if heard:
        raise UsageError(
            f"--isolate: other programs cannot reach the external inputs {', '.join(heard)}; leave"
            " --isolate out, or connect them"
        )


def time_problems(project: Project, nodes: Sequence[Node], end: Duration) -> Sequence[Problem]:
    """What is wrong if these nodes are to end in simulated time."""
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
    """Make what is missing, and say so; ``KeyboardInterrupt`` ends it at any time.

    Raises:
        EnvironmentFault: with all that failed.
    """
    pythons.note_use()
    if messages is not None:
        messages.note_use()
    if are_made(pythons, messages):
        return
    # pip, the compiler, and what they start must not outlive a launcher that is killed.
    run_id = os.urandom(8).hex()
    reaper = Reaper.start(run_id)
    try:
        progress = Progress(output)
        if messages is not None:
            messages.make(progress, {**without_mark(os.environ), RUN_ID: run_id})
        pythons.make(progress, {RUN_ID: run_id})
    finally:
        reaper.finish()


def are_made(pythons: Pythons, messages: Messages | None) -> bool:
    """Whether nothing is missing."""
    return pythons.is_made and (messages is None or messages.is_made)
