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
from typing import Any

from neuros.api.live import LiveRun
from neuros.backends.control_sockets import SESSION_SOCKET_NAME, connect_unix
from neuros.control import TO_SESSION, Advance, AtRest, Deliver, Ended, Message
from neuros.control.link import Arrivals, ControlLink
from neuros.errors import UsageError
from neuros.project.model import Node, Port, Project
from neuros.project.names import SESSION
from neuros.project.scanner import display_name, place_of
from neuros.project.suggest import did_you_mean

_MOST_UNSENT = 64


@dataclass(frozen=True)
class Held:
    """A run that stands still from its start, for a session.

    Attributes:
        project: as it is described, without the inputs of the session.
        inputs: the names of these.
        messages: folders of its message packages, for ``sys.path``.
    """

    live: LiveRun
    project: Project
    inputs: frozenset[str]
    messages: Sequence[Path]


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
    if node_name not in nodes or not port_name:
        hint = did_you_mean(node_name, nodes) or f"it has {', '.join(nodes)}"
        file = display_name(project.file)
        raise UsageError(f"'{name}': {file} has no node '{node_name}' ({hint}); say node.port")
    node = nodes[node_name]
    ports = {port.name: port for port in (node.inputs if is_input else node.outputs)}
    if port_name not in ports:
        hint = did_you_mean(port_name, ports) or f"it has {', '.join(ports) or 'none'}"
        side = "input" if is_input else "output"
        raise UsageError(f"'{name}': no such {side} ({hint}); {declared_at(node)}")
    return node, ports[port_name]


def declared_at(node: Node) -> str:
    """Where a node is declared, for messages."""
    line, column = place_of(node.file, node.pointer)
    place = f":{line}:{column}" if line else ""
    return f"node '{node.name}' is declared in {display_name(node.file)}{place}"
