"""The run that a session holds: what it is asked for, and how a run in other processes answers."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

from neuros.api.live import LiveRun
from neuros.api.run import Run
from neuros.backends.control_sockets import connect
from neuros.control import (
    TO_OBSERVERS,
    Advance,
    AtRest,
    Change,
    Deliver,
    Ended,
    GetStatus,
    Message,
    NodeStatus,
    Pause,
    Reset,
    Resume,
    WasReset,
    Watch,
)
from neuros.control.link import Arrivals, ControlLink, decode, decoder_of
from neuros.errors import ControlError, UsageError
from neuros.node.node import LAST_PACKETS
from neuros.ports import Changes
from neuros.project.model import Node, Port, Project
from neuros.project.names import SESSION
from neuros.project.scanner import display_name, place_of, read_bytes
from neuros.project.suggest import did_you_mean
from neuros.transport.messages import RosPackets

_CONNECT_S = 0.01


class HeldRun(Protocol):
    """A run that stands still from its start, but for the steps of a session.

    Its answers are those of ``advance`` on the control channel (:class:`neuros.control.AtRest`):
    simulated times, and the packets after the ``known`` number of each output that is asked for.
    ``None`` says that the run has ended; :meth:`wait` returns it then.

    Attributes:
        folder: the run folder.
        is_behind: whether a step was given up, and nothing has come to rest since.
        error: of the node that has failed, where it was in this process.
    """

    folder: Path

    @property
    def error(self) -> BaseException | None: ...

    @property
    def is_behind(self) -> bool: ...

    def begin(self, known: Mapping[str, int]) -> AtRest | None:
        """Wait until the initialise hooks have run."""

    def advance(
        self,
        rounds: int,
        known: Mapping[str, int],
        end_s: float | None = None,
        end_sim_s: float | None = None,
    ) -> AtRest | None:
        """Go on by rounds, then wait until nothing moves.

        Args:
            end_s: how long to wait at most (monotonic, seconds).
            end_sim_s: no round begins at this simulated time; where the nodes are in processes of
                their own, some may in real time.

        Raises:
            TimeoutError: if it takes longer; what goes on is waited for by the next call.
        """

    def run_for(self, duration_s: float, known: Mapping[str, int]) -> AtRest | None:
        """Let the run go freely for a time of its clock, then hold it again, and wait for that."""

    def deliver(self, node: str, port: Port, packet: Any) -> None:
        """Put a packet, which has been checked, into the queue of an input."""

    def copy(self, type_name: str, content: Any) -> Any:
        """A packet of its own for the program, from the content that came with an answer."""

    def view(self, type_name: str, content: Any) -> Any:
        """The packet of such a content, which nobody may change."""

    def size_of(self, content: Any) -> int:
        """The bytes of the content of a packet."""

    def reset(
        self, variables: Mapping[str, Mapping[str, str]], keep: Mapping[str, Sequence[str]]
    ) -> bool:
        """Bring all nodes back to their start, paused; ``False`` if they cannot be, or have ended.

        Args:
            variables: of their environments that change, by node.
            keep: names of the values of their plugins that survive, by node.
        """

    def change(self, changes: Changes, *, only_checks: bool = False) -> AtRest | None:
        """Change environments and parameters of nodes, which go on from where they are.

        Args:
            only_checks: whether to check that this is possible, and to change nothing.
        """

    def look(self) -> Sequence[NodeStatus] | None:
        """State and counters of each node."""

    def stop(self, reason: str) -> None:
        """End the run, drained."""

    def interrupt(self, reason: str, exit_code: int) -> None:
        """End the run now."""

    def wait(self) -> Run:
        """Wait for the end of the run."""

    def last_packets(self, output: str) -> tuple[int, Sequence[Any]]:
        """Of an output, after the end: the number of the newest packet, and the last ones."""


@dataclass(frozen=True)
class Held:
    """A run for a session.

    Attributes:
        project: as it is described, without the inputs of the session.
        inputs: the names of these.
        messages: folders of its message packages, for ``sys.path``.
    """

    run: HeldRun
    project: Project
    inputs: frozenset[str]
    messages: Sequence[Path]


class LaunchedRun:
    """A run in processes of its own (:class:`HeldRun`): an observer on its control channel."""

    error = None

    def __init__(self, live: LiveRun, project: Project) -> None:
        self.folder = live.folder
        self._live = live
        self._nodes = len(project.nodes)
        self._is_virtual = project.is_virtual
        self._packets = RosPackets()
        self._arrivals = Arrivals()
        self._number = self._answered = 0
        self._run: Run | None = None
        try:
            self._supervisor = self._connect()
            if self._supervisor is not None:
                self._arrivals.register(self._supervisor)
                self._send(Watch())
        except BaseException:
            live.end()
            raise

    @property
    def is_behind(self) -> bool:
        return self._answered != self._number

    def begin(self, known: Mapping[str, int]) -> AtRest | None:
        return self.advance(0, known)

    def advance(
        self,
        rounds: int,
        known: Mapping[str, int],
        end_s: float | None = None,
        end_sim_s: float | None = None,
    ) -> AtRest | None:
        if not self._is_virtual or rounds <= 1:
            return self._advance(rounds, known, end_s)
        for _ in range(rounds):  # a round begins when nothing moves, which is a virtual time
            found = self._advance(1, {}, end_s)
            if found is None:
                return None
            if end_sim_s is not None and max(found.sim_times.values(), default=0.0) >= end_sim_s:
                break
        return self._advance(0, known, end_s)

    def _advance(
        self, rounds: int, known: Mapping[str, int], end_s: float | None, virtual_ns: int = 0
    ) -> AtRest | None:
        self._number += 1
        self._send(Advance(self._number, rounds, known, virtual_ns))
        for message in self._messages(end_s):
            if isinstance(message, AtRest) and message.number == self._number:
                self._answered = self._number
                return message
        return None

    def run_for(self, duration_s: float, known: Mapping[str, int]) -> AtRest | None:
        if self._is_virtual:
            return self._advance(0, known, None, round(duration_s * 1e9))
        self._send(Resume())
        try:
            with contextlib.suppress(TimeoutError):
                for _ in self._messages(time.monotonic() + duration_s):
                    pass
        finally:
            self._send(Pause())
        return self.advance(0, known)

    def deliver(self, node: str, port: Port, packet: Any) -> None:
        self._send(Deliver(node, port.name, self._packets.encode(packet)))

    def copy(self, type_name: str, content: bytes) -> Any:
        return self._packets.decode(type_name, content)

    view = copy

    def size_of(self, content: bytes) -> int:
        return len(content)

    def reset(
        self, variables: Mapping[str, Mapping[str, str]], keep: Mapping[str, Sequence[str]]
    ) -> bool:
        # A round that was given up may go on for ever: it ends as a free run does.
        if (self.run_for(0.0, {}) if self.is_behind else self.advance(0, {})) is None:
            return False
        self._send(Reset(variables, {node: tuple(names) for node, names in keep.items()}))
        answers = (each for each in self._messages() if isinstance(each, WasReset))
        return any(not answer.why_not for answer in islice(answers, 1))

    def change(self, changes: Changes, *, only_checks: bool = False) -> AtRest | None:
        for node, (variables, parameters) in changes.items():
            self._send(Change(node, variables, parameters, only_checks))
        return self.advance(0, {})

    def resume(self) -> None:
        """Let the run go freely from now on."""
        self._send(Resume())

    def look(self) -> Sequence[NodeStatus] | None:
        if not self.is_behind:  # else a round goes on, perhaps for ever
            self.advance(0, {})  # what was sent has arrived then
        self._send(GetStatus({}))
        found: dict[str, NodeStatus] = {}
        for message in self._messages():
            if isinstance(message, NodeStatus):
                found[message.node] = message
                if len(found) == self._nodes:
                    return [*found.values()]
        return None

    def stop(self, reason: str) -> None:
        self._live.stop(reason)

    def interrupt(self, reason: str, exit_code: int) -> None:
        self._live.fail(reason, exit_code)

    def wait(self) -> Run:
        if self._run is None:
            self._run = self._live.wait()
        if self._supervisor is not None:
            self._supervisor.close()
            self._supervisor = None
        return self._run

    def last_packets(self, output: str) -> tuple[int, Sequence[Any]]:
        file = self.folder / output.partition(".")[0] / LAST_PACKETS
        with contextlib.suppress(OSError, ControlError):  # the node was killed
            last = decode(read_bytes(file), decoder_of((AtRest,)), str(file))
            if isinstance(last, AtRest) and output in last.packets:
                return last.packets[output]
        return 0, ()

    def _connect(self) -> ControlLink | None:
        """The connection to the supervisor; ``None`` if the run has ended before."""
        while True:
            try:
                return ControlLink(
                    connect(self._live.control_address), TO_OBSERVERS, "the supervisor"
                )
            except OSError:
                with contextlib.suppress(TimeoutError):
                    self._run = self._live.wait(_CONNECT_S)
                    return None

    def _send(self, message: Message) -> None:
        if self._supervisor is not None:
            self._supervisor.send(message)

    def _messages(self, end_s: float | None = None) -> Iterator[Message]:
        """What the supervisor sends, until the run has ended.

        Raises:
            TimeoutError: if it has not ended until ``end_s`` (monotonic, seconds).
        """
        is_over = False
        while self._supervisor is not None and not is_over:
            left_ms = None if end_s is None else max(0.0, end_s - time.monotonic()) * 1e3
            if not self._arrivals.wait(left_ms):
                raise TimeoutError(f"the run has not come to rest in time: {self.folder}")
            messages = self._supervisor.receive()
            is_over = messages is None or any(isinstance(each, Ended) for each in messages)
            yield from messages or ()


def with_session_inputs(project: Project, taken: Sequence[str]) -> tuple[Project, tuple[str, ...]]:
    """The project with the inputs that a session feeds bound to it, and the names of these.

    They are the inputs that nothing is connected to, those with an external topic, and those that
    are ``taken`` over, which lose their connections.

    Raises:
        UsageError: if a name is that of no input.
    """
    ends = (port_of(project, name, is_input=True) for name in taken)
    chosen = {f"{node.name}.{port.name}" for node, port in ends}
    connections = [c for c in project.connections if _end_of(c) not in chosen]
    connected = {_end_of(c) for c in connections}
    nodes, names = [], []
    for node in project.nodes:
        inputs = []
        for port in node.inputs:
            name = f"{node.name}.{port.name}"
            if name not in connected:
                names.append(name)
                if port.external_topic is None:
                    port = replace(port, external_topic=f"{SESSION}{node.name}/{port.name}")
            inputs.append(port)
        nodes.append(replace(node, inputs=tuple(inputs)))
    bound = replace(project, nodes=tuple(nodes), connections=tuple(connections))
    return bound, tuple(names)


def _end_of(connection: Any) -> str:
    return f"{connection.destination_node}.{connection.destination_input}"


def connections_to(project: Project, name: str) -> list[str]:
    """The connections that feed an input."""
    return [str(c) for c in project.connections if _end_of(c) == name]


def port_of(project: Project, name: str, *, is_input: bool) -> tuple[Node, Port]:
    """A port by ``node.port``.

    Raises:
        UsageError: if there is none of that name; it says where the node is declared.
    """
    node_name, _, port_name = name.partition(".")
    nodes = {node.name: node for node in project.nodes}
    if node_name not in nodes:
        hint = did_you_mean(node_name, nodes) or f"it has {', '.join(nodes)}"
        file = display_name(project.file)
        raise UsageError(f"'{name}': {file} has no node '{node_name}' ({hint}); say node.port")
    node = nodes[node_name]
    ports = {port.name: port for port in (node.inputs if is_input else node.outputs)}
    side = "input" if is_input else "output"
    if not port_name:
        known = ", ".join(f"{node_name}.{port}" for port in ports) or "none"
        raise UsageError(f"'{name}' is a node: name one of its {side}s, which are {known}")
    if port_name not in ports:
        hint = did_you_mean(port_name, ports) or f"it has {', '.join(ports) or 'none'}"
        raise UsageError(f"'{name}': no such {side} ({hint}); {declared_at(node)}")
    return node, ports[port_name]


def declared_at(node: Node) -> str:
    """Where a node is declared, for messages."""
    line, column = place_of(node.file, node.pointer)
    place = f":{line}:{column}" if line else ""
    return f"node '{node.name}' is declared in {display_name(node.file)}{place}"
