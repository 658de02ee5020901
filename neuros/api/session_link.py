"""The run that a session holds, and their connection: it asks, and waits for the answer.

Where one process holds all nodes, steps go straight to it. The supervisor is a thread of the
program that steps, and takes turns with it: through the supervisor, a step takes several times as
long. It takes no part in such a step; it hears of failures and ends from the nodes.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from neuros.api.live import LiveRun
from neuros.api.run import Run
from neuros.backends.control_sockets import SESSION_SOCKET_NAME, connect, connect_unix
from neuros.control import (
    TO_OBSERVERS,
    TO_SESSION,
    Advance,
    AtRest,
    Deliver,
    Ended,
    LookAll,
    Message,
    NodeStatus,
    Pause,
    Reset,
    Resume,
    WasReset,
    Watch,
)
from neuros.control.link import Arrivals, ControlLink
from neuros.errors import UsageError
from neuros.project.model import Node, Port, Project
from neuros.project.names import SESSION
from neuros.project.scanner import display_name, place_of
from neuros.project.suggest import did_you_mean
from neuros.transport.messages import RosPackets

_CONNECT_S = 0.01
_MOST_UNSENT = 64
_Answer = TypeVar("_Answer")


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
            end_sim_s: no round begins at this simulated time; where the nodes are in several
                processes, some may.

        Raises:
            TimeoutError: if it takes longer; what goes on is waited for by the next call.
        """

    def run_for(self, duration_s: float, known: Mapping[str, int]) -> AtRest | None:
        """Let the run go freely for a wall time, then hold it again, and wait for that."""

    def deliver(self, node: str, input_name: str, packet: Any) -> None:
        """Put a packet, which has been checked, into the queue of an input."""

    def copy(self, type_name: str, content: Any) -> Any:
        """A packet of its own for the program, from the content that came with an answer."""

    def reset(
        self, variables: Mapping[str, Mapping[str, str]], keep: Mapping[str, Sequence[str]]
    ) -> bool:
        """Bring all nodes back to their start, paused; ``False`` if they cannot be, or have ended.

        Args:
            variables: of their environments that change, by node.
            keep: names of the values of their plugins that survive, by node.
        """

    def look(self) -> Sequence[NodeStatus] | None:
        """State and counters of each node."""

    def stop(self, reason: str) -> None:
        """End the run, drained."""

    def interrupt(self, reason: str, exit_code: int) -> None:
        """End the run now."""

    def wait(self) -> Run:
        """Wait for the end of the run."""


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
    """A run in processes of its own (:class:`HeldRun`)."""

    error = None

    def __init__(self, live: LiveRun, nodes: int) -> None:
        self.folder = live.folder
        self._live = live
        self._nodes = nodes
        self._packets = RosPackets()
        self._run: Run | None = None
        try:
            stream = self._connect()
            self._link = None if stream is None else SessionLink(stream, self.folder)
            if self._link is not None:
                self._link.send(Watch())
        except BaseException:
            live.end()
            raise

    @property
    def is_behind(self) -> bool:
        return self._link is not None and self._link.is_behind

    def begin(self, known: Mapping[str, int]) -> AtRest | None:
        return self._after(lambda link: link.settle(known))

    def advance(
        self,
        rounds: int,
        known: Mapping[str, int],
        end_s: float | None = None,
        end_sim_s: float | None = None,
    ) -> AtRest | None:
        return self._after(lambda link: link.advance(rounds, known, end_s, end_sim_s))

    def run_for(self, duration_s: float, known: Mapping[str, int]) -> AtRest | None:
        def run(link: SessionLink) -> AtRest | None:
            link.send(Resume())
            try:
                with contextlib.suppress(TimeoutError):
                    if not link.wait_for(lambda _: False, time.monotonic() + duration_s):
                        return None
            finally:
                link.send(Pause())
            return link.settle(known)

        return self._after(run)

    def deliver(self, node: str, input_name: str, packet: Any) -> None:
        assert self._link is not None
        self._link.deliver(node, input_name, self._packets.encode(packet))

    def copy(self, type_name: str, content: bytes) -> Any:
        return self._packets.decode(type_name, content)

    def reset(
        self, variables: Mapping[str, Mapping[str, str]], keep: Mapping[str, Sequence[str]]
    ) -> bool:
        def reset(link: SessionLink) -> WasReset | None:
            # A round that was given up may go on for ever: it ends as a free run does.
            at_rest = self.run_for(0.0, {}) if link.is_behind else link.advance(0, {}, None)
            if at_rest is None:
                return None
            link.send(Reset(variables, {node: tuple(names) for node, names in keep.items()}))
            return link.answer(WasReset)

        answer = self._after(reset)
        return answer is not None and not answer.why_not

    def look(self) -> Sequence[NodeStatus] | None:
        found: dict[str, NodeStatus] = {}

        def is_last(message: Message) -> bool:
            if isinstance(message, NodeStatus):
                found[message.node] = message
            return len(found) == self._nodes

        def look(link: SessionLink) -> Sequence[NodeStatus] | None:
            if not link.is_behind:  # else a round goes on, perhaps for ever
                link.advance(0, {}, None)  # what was sent has arrived then
            link.send(LookAll({}))
            return [*found.values()] if link.wait_for(is_last, None) else None

        return self._after(look)

    def stop(self, reason: str) -> None:
        if self._link is not None:
            self._link.leave_nodes()
        self._live.stop(reason)

    def interrupt(self, reason: str, exit_code: int) -> None:
        self._live.interrupt()

    def wait(self) -> Run:
        if self._run is None:
            if self._link is not None:
                self._link.leave_nodes()
            self._run = self._live.wait()
            if self._link is not None:
                self._link.close()
        return self._run

    def _after(self, ask: Callable[[SessionLink], _Answer | None]) -> _Answer | None:
        """The answer to a question; ``None`` if the run has ended."""
        return None if self._link is None or self._run is not None else ask(self._link)

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


class SessionLink:
    """Connection of a session with its run.

    Args:
        supervisor: of the run.
        folder: the run folder.
    """

    def __init__(self, supervisor: ControlLink, folder: Path) -> None:
        self._supervisor = supervisor
        self._folder = folder
        self._nodes: ControlLink | None = None
        self._arrivals = Arrivals()
        self._arrivals.register(supervisor)
        self._unsent: list[tuple[str, str, bytes]] = []
        self._number = self._answered = 0
        self._is_due = False  # whether the nodes have still to answer a step

    @property
    def is_behind(self) -> bool:
        """Whether a step was given up, and nothing has come to rest since."""
        return self._answered != self._number

    def send(self, message: Message) -> None:
        """Send to the supervisor, behind all that was sent before."""
        self._catch_up()
        self._supervisor.send(message)

    def deliver(self, node: str, input_name: str, content: bytes) -> None:
        """Send a packet, with the next step at the latest."""
        if self._nodes is None or self._is_due:
            self._supervisor.send(Deliver(node, input_name, content))
            return
        self._unsent.append((node, input_name, content))
        if len(self._unsent) >= _MOST_UNSENT:
            self._catch_up()

    def settle(
        self, known: Mapping[str, int], end_s: float | None = None, *, rounds: int = 0
    ) -> AtRest | None:
        """Go on by rounds, then wait until nothing moves, both by the supervisor.

        What has been said to the supervisor comes before. See :meth:`advance`.
        """
        self._catch_up()
        self._number += 1
        self._supervisor.send(Advance(self._number, rounds, known))
        found: list[AtRest] = []

        def is_answer(message: Message) -> bool:
            if isinstance(message, AtRest) and message.number == self._number:
                found.append(message)
            return bool(found)

        if not self.wait_for(is_answer, end_s):
            return None
        if self._is_due:  # a step that was given up, and may have begun late
            return self.settle(known, end_s) if self._hear_answer(end_s) else None
        self._answered = self._number
        if self._nodes is None:
            with contextlib.suppress(OSError):  # they are in several processes, or out of reach
                stream = connect_unix(self._folder / SESSION_SOCKET_NAME)
                self._nodes = ControlLink(stream, TO_SESSION, "the nodes")
                self._arrivals.register(stream)
        return found[0]

    def advance(
        self,
        rounds: int,
        known: Mapping[str, int],
        end_s: float | None,
        end_sim_s: float | None = None,
    ) -> AtRest | None:
        """Go on by rounds, then wait until nothing moves.

        While an answer of the nodes is due (a step was given up), this goes by the supervisor, as
        all else that is said: the nodes may write that answer, and do not read meanwhile.

        Args:
            known: outputs to show, and the number of the newest known packet.
            end_s: as for :meth:`wait_for`, whose errors it raises.
            end_sim_s: no round begins at this simulated time; only where steps go straight to the
                nodes.

        Returns:
            ``None`` if the run has ended.
        """
        if self._nodes is None or self._is_due:
            return self.settle(known, end_s, rounds=rounds)
        self._number += 1
        self._send_to(self._nodes, rounds, known, end_sim_s)
        answer = self._hear_answer(end_s)
        if answer is not None:
            self._answered = answer.number
        return answer

    def wait_for(self, is_wanted: Callable[[Message], bool], end_s: float | None) -> bool:
        """Until such a message comes from the supervisor; ``False`` once the run has ended.

        Raises:
            TimeoutError: if neither comes until ``end_s`` (monotonic, seconds).
        """
        while True:
            for number in self._ready(end_s):
                if number != self._supervisor.fileno():
                    self._hear_nodes()  # an answer that is no longer waited for
                elif (is_there := self._hear_supervisor(is_wanted)) is not None:
                    return is_there

    def answer(self, kind: type[_Answer]) -> _Answer | None:
        """The next message of a kind from the supervisor; ``None`` if the run has ended."""
        answers: list[_Answer] = []

        def is_answer(message: Message) -> bool:
            if isinstance(message, kind):
                answers.append(message)
            return bool(answers)

        return answers[0] if self.wait_for(is_answer, None) else None

    def leave_nodes(self) -> None:
        """Send what waits, and hear the nodes no more: none waits for its answer to be read."""
        if self._nodes is not None:
            if self._unsent and not self._is_due:
                self._send_to(self._nodes, 0, {})
            self._arrivals.unregister(self._nodes)
            self._nodes.close()
            self._nodes, self._is_due = None, False

    def close(self) -> None:
        """Hang up."""
        self._supervisor.close()

    def _ready(self, end_s: float | None) -> list[int]:
        """Descriptors of the connections on which something has come."""
        left_ms = None if end_s is None else max(0.0, end_s - time.monotonic()) * 1e3
        ready = self._arrivals.wait(left_ms)
        if not ready:
            raise TimeoutError(f"the run has not come to rest in time: {self._folder}")
        return ready

    def _hear_supervisor(self, is_wanted: Callable[[Message], bool]) -> bool | None:
        """Whether such a message has come; ``None`` if not, and the run goes on."""
        messages = self._supervisor.receive()
        is_over = messages is None
        for message in messages or ():
            if is_wanted(message):
                return True
            is_over = is_over or isinstance(message, Ended)
        return False if is_over else None

    def _hear_answer(self, end_s: float | None) -> AtRest | None:
        """What the nodes answer; ``None`` if the run has ended."""
        while self._nodes is not None:
            is_over = False
            for number in self._ready(end_s):
                if number == self._supervisor.fileno():
                    is_over = self._hear_supervisor(lambda _: False) is not None
                elif answers := self._hear_nodes():
                    return answers[0]
            if is_over:
                return None
        self.wait_for(lambda _: False, end_s)  # the supervisor says why they have gone
        return None

    def _hear_nodes(self) -> list[AtRest]:
        """The answer to the last step, once it has come."""
        assert self._nodes is not None
        received = self._nodes.receive()
        if received is None:
            self.leave_nodes()
            return []
        answers = [each for each in received if isinstance(each, AtRest)]
        self._is_due = self._is_due and not answers
        return answers

    def _catch_up(self) -> None:
        """Wait for the nodes: what they are told on two ways comes in any order."""
        if self._nodes is not None and self._unsent:
            self.advance(0, {}, None)

    def _send_to(
        self,
        nodes: ControlLink,
        rounds: int,
        known: Mapping[str, int],
        end_sim_s: float | None = None,
    ) -> None:
        self._is_due = True
        nodes.send(Advance(self._number, rounds, known, tuple(self._unsent), end_sim_s))
        self._unsent.clear()


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
    return f"node '{node.name}' is declared in {display_name(node.file)}:{line}:{column}"
