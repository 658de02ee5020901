"""The supervisor's ends of the control channel: node processes, and observers of the run.

Nothing here ever waits for a node: one that is stopped, or has forked children which keep its
socket open, must not hold up the supervisor. Nor may other programs: node processes come first, and
of each other program what has arrived is read once at a time.

Observers are programs that may pause, step and end a run. They see what nodes show when asked (they
ask while a user looks), and take no part in the run: when the last one has gone, a run that was
paused goes on. A session asks, too, when a step of a paused run is over.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import neuros.control as control
from neuros.control import Message
from neuros.control.link import ControlLink, encode
from neuros.errors import ControlError
from neuros.launcher.outcome import Outcome, Phase
from neuros.ports import ControlListener

STRANGER = "an unknown program"
_MOST_UNSENT_BYTES = 1 << 20
_LEFT_OUT = control.GetStatus, control.NodeStatus, control.LogRecord
"""Messages that are left out while so much waits to be sent."""
_READS_AT_A_TIME = 64
_WAKING_BYTES = 1024


class Channels:
    """All programs that have connected to the control channel of a run.

    Attributes:
        parted: the nodes of each process that has hung up, and when (``time.monotonic()``).

    Raises:
        EnvironmentFault: if there can be no such channel.
    """

    def __init__(self, listener: ControlListener) -> None:
        listener.open()
        self._listener = listener
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._links: dict[ControlLink, None] = {}  # in the order in which they came
        self._nodes: dict[ControlLink, tuple[str, ...]] = {}  # as they said hello
        self.parted: dict[tuple[str, ...], float] = {}
        self._waker: socket.socket | None = None

    def wake_on(self, waker: socket.socket) -> None:
        """Have :meth:`wait` return when bytes arrive on ``waker``, too; they are dropped."""
        waker.setblocking(False)
        self._waker = waker
        self._selector.register(waker, selectors.EVENT_READ)

    def wait(self, timeout_s: float) -> None:
        """Until something arrives, ``timeout_s`` at most."""
        woken_by = self._ready(timeout_s)
        if self._waker is not None and self._waker in woken_by:
            with contextlib.suppress(BlockingIOError):
                while self._waker.recv(_WAKING_BYTES) != b"":
                    pass

    def receive(self) -> Iterator[tuple[ControlLink, Message | ControlError]]:
        """All that has arrived. What a process sent before it ended is there when it has ended.

        A message that is not understood comes as the error that says why.
        """
        ready = self._ready()
        if self._listener in ready:
            while (stream := self._listener.accept()) is not None:
                stream.setblocking(False)
                link = ControlLink(stream, (control.Hello, control.Watch), STRANGER)
                self._links[link] = None
                self._selector.register(link, selectors.EVENT_READ)
            ready = self._ready()  # who has just come in may have said something, and have gone
        others = [link for link in self._links if link not in self._nodes]
        for link in (*self._nodes, *others):
            if link in ready:
                yield from self._read(link)

    def send(self, message: Message) -> None:
        for link in tuple(self._nodes):
            self.send_to(link, message)

    def send_to_node(self, name: str, message: Message) -> None:
        for link, names in tuple(self._nodes.items()):
            if name in names:
                self.send_to(link, message)

    @property
    def process_count(self) -> int:
        return len(self._nodes)

    def send_to(self, link: ControlLink, message: Message) -> None:
        """Send to one; what does not go through now goes with the next, or :meth:`flush`.

        What an observer looks at is left out while too much waits. What it waits for, or has sent
        to a node, never is.
        """
        if link not in self._links:
            return
        is_full = len(link.unsent) >= _MOST_UNSENT_BYTES
        if is_full and isinstance(message, _LEFT_OUT):
            return
        link.unsent += encode(message)
        link.flush()

    def nodes_of(self, link: ControlLink) -> Sequence[str]:
        """The nodes of the process that is, or was, at the other end; none: another program."""
        return self._nodes.get(link, ())

    def has(self, link: ControlLink) -> bool:
        return link in self._links

    def flush(self) -> None:
        """Try again to send what did not go through."""
        for link in self._links:
            link.flush()

    def hang_up(self, link: ControlLink) -> None:
        if link in self._links:
            del self._links[link]
            self._selector.unregister(link)
            link.close()

    def close(self) -> None:
        for link in tuple(self._links):
            self.hang_up(link)
        self._selector.close()
        self._listener.close()

    def _ready(self, timeout_s: float = 0.0) -> set[object]:
        """What has something to read: one system call instead of one for each connection."""
        return {key.fileobj for key, _ in self._selector.select(timeout_s)}

    def _read(self, link: ControlLink) -> Iterator[tuple[ControlLink, Message | ControlError]]:
        """All messages of a node process; of another program, those of one read."""
        for _ in range(_READS_AT_A_TIME):
            if link not in self._links:
                return
            try:
                found = link.read()
            except BlockingIOError:
                return
            except ControlError as error:
                yield link, error
                return
            for data in found or ():
                try:
                    message = link.decode(data)
                except ControlError as error:
                    yield link, error
                    continue
                if isinstance(message, control.Hello):
                    self._nodes[link] = tuple(message.nodes)
                    link.accept(control.FROM_NODES)
                    link.peer = f"the process of {' and '.join(message.nodes)}"
                elif isinstance(message, control.Watch):
                    link.accept(control.FROM_OBSERVERS)
                    link.peer = "an observer"
                yield link, message
            if found is None:
                if link in self._nodes:
                    self.parted[self._nodes[link]] = time.monotonic()
                self.hang_up(link)
            if link not in self._nodes:
                return


@dataclass
class PauseState:
    """The pause of a run, and the time that it has been paused in all.

    Attributes:
        send: to all nodes.
        clock: monotonic, seconds.
        since_s: when the run was paused, on the clock; ``None`` while it is not.
    """

    send: Callable[[Message], object]
    clock: Callable[[], float]
    since_s: float | None = None
    _before_s: float = 0.0

    @property
    def is_on(self) -> bool:
        return self.since_s is not None

    @property
    def total_s(self) -> float:
        """Seconds of pause so far."""
        return self._before_s + (0.0 if self.since_s is None else self.clock() - self.since_s)

    def begin(self) -> None:
        if self.since_s is None:
            self.since_s = self.clock()
            self.send(control.Pause())

    def end(self) -> None:
        if self.since_s is not None:
            self.forget()
            self.send(control.Resume())

    def forget(self) -> None:
        """The pause is over without a request: nodes that drain go on by themselves."""
        self._before_s, self.since_s = self.total_s, None

    def step(self, count: int, *, is_driven: bool, virtual_ns: int = 0) -> None:
        """Run ``count`` steps of a paused run, or let it go for a virtual time."""
        if self.since_s is not None and (count > 0 or virtual_ns > 0):
            self.send(control.Step(count, is_driven, virtual_ns))


@dataclass
class Observers:
    """The observers of one run.

    Args:
        _is_driven: whether some node starts hooks unasked, and so drives the project.
        _end: ends the run, drained: ``end(reason)``.
        _session_inputs: ``(node, input)`` of those that a session may send to; none in other runs.
    """

    _channels: Channels
    _pause: PauseState
    _is_driven: Callable[[], bool]
    _end: Callable[[str], None]
    _session_inputs: Container[tuple[str, str]] = ()
    _links: dict[int, ControlLink] = field(default_factory=dict)  # numbers are not given out again
    _count: int = 0
    _told: control.PhaseChanged | None = None
    _asked: dict[int, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)

    def receive(self, link: ControlLink, message: Message) -> None:
        """Handle a message from or for an observer.

        Raises:
            ControlError: if it is a packet for what is no session's input; nothing has changed.
        """
        match message:
            case control.Watch() if link not in self._links.values():
                self._count += 1
                self._links[self._count] = link
                self._told = None
            case control.GetStatus(wanted):
                for number, each in self._links.items():
                    if each is link:
                        self._asked[number] = wanted
            case control.NodeStatus(asker=asker):
                if asker in self._links:
                    self._channels.send_to(self._links[asker], message)
            case control.Pause():
                self._pause.begin()
            case control.Resume():
                self._pause.end()
            case control.Reset():
                if self._channels.process_count == 1:
                    self._channels.send(message)
                else:
                    is_early = not self._channels.process_count
                    why = "have not started yet" if is_early else "are in several processes"
                    self._channels.send_to(link, control.WasReset(f"its nodes {why}"))
            case control.WasReset():
                self.tell(message)
            case control.Deliver(node, input_name):
                if (node, input_name) not in self._session_inputs:
                    whither = f"'{node}.{input_name}'"
                    raise ControlError(f"a packet came for {whither}, no session's input")
                self._channels.send_to_node(node, message)
            case control.Change(node):
                self._channels.send_to_node(node, message)
            case control.Step(count):
                self._pause.step(count, is_driven=self._is_driven())
            case control.End(reason):
                self._end(reason)

    def tell(self, message: Message) -> None:
        for link in self._links.values():
            self._channels.send_to(link, message)

    def update(self, phase: Phase) -> None:
        """Ask nodes for the statuses that observers want, and send these a change of phase.

        An observer that has asked several times since is answered once. When the last observer has
        gone, a paused run goes on.
        """
        for number, wanted in self._asked.items():
            self._channels.send(control.GetStatus(wanted, number))
        self._asked.clear()
        if phase is not Phase.RUNNING and self._pause.is_on:
            self._pause.forget()
        if not self._links:
            return
        self._links = {n: link for n, link in self._links.items() if self._channels.has(link)}
        if not self._links:
            self._pause.end()
        now = control.PhaseChanged(phase.value, self._pause.is_on)
        if now != self._told:
            self._told = now
            self.tell(now)

    def end(self, outcome: Outcome) -> None:
        """Send observers the end of the run."""
        self.tell(
            control.Ended(
                outcome.exit_code,
                outcome.reason,
                outcome.reports,
                outcome.running_s,
                outcome.real_time_factor,
                outcome.has_drained,
            )
        )
