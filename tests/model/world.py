"""A project of real engines whose surroundings are a model: every order of events can be chosen.

Between nodes, packets of a connection keep their order, and so do its acknowledgements; nothing
else is promised, as between DDS endpoints. A packet that is sent before its receiver is there is
gone. On connections without acknowledgements packets may be lost on their way. The launcher is a
model, too, but it judges with its own :class:`~neuros.launcher.quiescence.Probing`.

Hooks number their packets, so that each can be told from each; what they take is judged at once.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from neuros.control import Message, NodeProbe, Probe, Probed
from neuros.engine.engine import Engine
from neuros.engine.hook import Hook
from neuros.hooks import HookKind, HookSpec
from neuros.launcher.quiescence import Probing, Verdict
from neuros.project.model import Connection, Port
from tests.engine.engine_bench import Clock, node_for

Event = Callable[[], None]


@dataclass(frozen=True)
class Packet:
    """The output that it left by (``node.output``), and its number there, from 1."""

    origin: str
    number: int


_LONGEST = 2
"""A run is ended when this many packets have left by some output, or before."""


class Broken(Exception):
    """A rule does not hold."""


@dataclass(frozen=True)
class Project:
    """What is modelled.

    Attributes:
        plugins: hooks by node; their functions get the :class:`ModelNode`.
        goal: the packets that every lossless connection has carried at the end of the run, unless
            something else ends that before.
        losses: how many packets at most are lost on connections without acknowledgements.
        ticks: how many ticks at most come due.
        may_crash: whether a node dies, at any time.
        shuts_down: whether a drained end is asked for, at any time.
        last_round: hooks that start once more while it drains, by node (see ``Engine.drain``).
    """

    name: str
    connections: Sequence[Connection]
    plugins: Mapping[str, Sequence[HookSpec]]
    goal: int = 0
    losses: int = 0
    ticks: int = 0
    may_crash: bool = False
    shuts_down: bool = False
    last_round: Mapping[str, Sequence[int]] = field(default_factory=dict)


class ModelNode:
    """One node: the effects of its engine, and its loop's queue of events."""

    def __init__(self, world: World, name: str, specs: Sequence[HookSpec]) -> None:
        self.world = world
        self.name = name
        self.clock = Clock(0)
        self.events: deque[Event] = deque()
        self.numbers: dict[str, int] = {}
        self.last_taken: dict[tuple[str, str, str], int] = {}
        self.is_there = self.is_ready = False
        self.is_dead = False
        self.is_over = False
        self.in_loop: list[str] = []
        self.last_round: list[str] | None = None  # while it drains: the hooks that start once more
        self.connections = [
            c for c in world.project.connections if name in (c.source_node, c.destination_node)
        ]
        self.engine = Engine(
            node_for(name, specs, self.connections), self.connections, specs, self, self.clock
        )

    def packet(self, output: str, most: int | None = None) -> Packet | None:
        """The next packet of an output; ``None`` after so many."""
        number = self.numbers.get(output, 0) + 1
        if most is not None and number > most:
            return None
        self.numbers[output] = number
        return Packet(f"{self.name}.{output}", number)

    # the engine's effects

    def has_taken_in(self) -> bool:
        return True

    def give_way(self) -> None: ...

    def note_ready(self) -> None:
        self.is_ready = True
        self.world.look_at_start()

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        if self.is_over:
            raise Broken(f"hook {self.name}.{hook.name} starts after the end")
        if hook.spec.kind is not HookKind.INITIALISE and not self.world.is_ready:
            raise Broken(f"hook {self.name}.{hook.name} starts before every node is ready")
        if self.last_round is not None:
            self._judge_draining(hook)
        for port, argument in zip(hook.spec.inputs, arguments, strict=True):
            for packet in argument if port.is_all else (argument,):
                if packet is not None:
                    self._judge(hook.name, port.name, packet.origin, packet.number)
        return hook.spec.function(self, *arguments)

    def sender(self, port: Port, connections: Sequence[Connection]) -> Callable[[Any], None]:
        assert port.external_topic is None
        return functools.partial(self._send, connections)

    def _send(self, connections: Sequence[Connection], packet: Packet) -> None:
        for c in connections:
            if self.world.nodes[c.destination_node].is_there:
                self.world.put(("data", c), packet)

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return functools.partial(self.world.put, ("ack", connection))

    def post(self, event: Event) -> None:
        self.events.append(event)

    post_loop_back = post

    def copy_to_itself(self, connection: Any, packet: Any) -> Any:
        return packet

    # the rules

    def _judge_draining(self, hook: Hook) -> None:
        """A hook starts while the project drains: it does not send unasked, or round and round."""
        assert self.last_round is not None
        if hook.spec.sends_unasked:
            raise Broken(f"hook {self.name}.{hook.name} sends unasked while the project drains")
        if hook.name in self.last_round:
            self.last_round.remove(hook.name)
        elif hook.name in self.in_loop:
            raise Broken(f"hook {self.name}.{hook.name} starts twice while the project drains")

    def _judge(self, hook: str, port: str, origin: str, number: int) -> None:
        """A hook takes a packet: no more may be missing before it than the connection allows."""
        key = (hook, port, origin)
        missing = number - self.last_taken.get(key, 0) - 1
        self.last_taken[key] = number
        c = next(c for c in self.connections if f"{c.source_node}.{c.source_output}" == origin
                 and (c.destination_node, c.destination_input) == (self.name, port))  # fmt: skip
        if missing < 0:
            raise Broken(f"{c}: {self.name}.{hook} takes packet {number} after a later one")
        if c.discard_limit is not None and missing > c.discard_limit:
            raise Broken(
                f"{c}: {missing} packets in a row are missing at {self.name}.{hook} before packet"
                f" {number}, and {c.discard_limit} may"
            )

    def check(self) -> None:
        """No more is under way, or waits, than the windows and queues of connections allow."""
        for c, window in self.engine.send_windows.items():
            if c.is_reliable and window.outstanding > c.window:
                raise Broken(f"{c}: {window.outstanding} outstanding, {c.window} may be")
        for c, subscription in self.engine.subscriptions.items():
            for queue in subscription.queues:
                if len(queue.packets) > subscription.capacity:
                    raise Broken(f"{c}: {len(queue.packets)} packets wait")


class World:
    """A project, and what is under way in it."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self.channels: dict[tuple[str, Any], deque[Any]] = {}
        self.fingerprints: dict[str, bytes] = {}  # of the nodes that are as they were
        self.losses, self.ticks = project.losses, project.ticks
        self.is_ending = self.is_drained = False
        self.has_crashed = False
        self.now_s = 0.0
        self.nodes = {name: ModelNode(self, name, specs) for name, specs in project.plugins.items()}
        self.probing = Probing(self.nodes, list(project.connections), self._to_all)

    def put(self, channel: tuple[str, Any], message: Any) -> None:
        """Something is under way."""
        self.channels.setdefault(channel, deque()).append(message)

    def choices(self) -> list[tuple[Any, ...]]:
        """All that can happen next, each by a label for :meth:`do`."""
        found: list[tuple[Any, ...]] = []
        if self._must_shut_down():
            return [("shut down",)]
        if late := self._orders_that_are_late():
            return late
        for name, node in self.nodes.items():
            if node.is_dead:
                continue
            if not node.is_there:
                found.append(("appear", name))
                continue
            if node.events:
                found.append(("event", name))
            if self.ticks and node.engine.next_due_ns is not None:
                found.append(("tick", name))
            if self.project.may_crash and not self.has_crashed and not self.is_ending:
                found.append(("crash", name))
        for channel, messages in self.channels.items():
            kind, about = channel
            if kind == "registered" and not self.nodes[about.source_node].is_there:
                continue
            if messages:
                found.append(("deliver", channel))
                if kind == "data" and self.losses and not about.is_reliable:
                    found.append(("lose", channel))
        if self.project.shuts_down and not self.is_ending and self._all_run():
            found.append(("shut down",))
        if self.is_ending and self._may_probe():
            found.append(("probe",))
        return found

    def do(self, choice: tuple[Any, ...]) -> None:
        """Let one of the choices happen."""
        getattr(self, f"_{choice[0].replace(' ', '_')}")(*choice[1:])

    @property
    def is_done(self) -> bool:
        """Whether it has come to where it should: the end, or the last packet taken."""
        if self.project.may_crash or self.project.shuts_down:
            return all(node.is_over or node.is_dead for node in self.nodes.values())
        return all(
            self._taken(c) >= self.project.goal
            for c in self.project.connections
            if c.discard_limit == 0
        )

    # what can happen

    def _node(self, name: str) -> ModelNode:
        """A node that does something now."""
        self.fingerprints.pop(name, None)
        return self.nodes[name]

    def _appear(self, name: str) -> None:
        """The endpoints of a node come to be: senders find them, sooner or later."""
        node = self._node(name)
        node.is_there = True
        for c in node.connections:
            if c.destination_node == name:
                self.put(("registered", c), None)
        node.engine.start(awaits_others=True)

    def _event(self, name: str) -> None:
        node = self._node(name)
        node.events.popleft()()
        node.check()

    def _tick(self, name: str) -> None:
        node = self._node(name)
        self.ticks -= 1
        node.clock.now_ns = max(node.clock.now_ns, node.engine.next_due_ns or 0)
        node.engine.on_timer()
        node.check()

    def _deliver(self, channel: tuple[str, Any]) -> None:
        kind, about = channel
        message = self.channels[channel].popleft()
        receives = {"data": "destination_node", "ack": "source_node", "registered": "source_node"}
        node = self._node(getattr(about, receives[kind]) if kind in receives else about)
        if node.is_dead:
            return
        if kind == "data":
            node.engine.on_packet(about, message)
        elif kind == "ack":
            node.engine.on_acknowledgement(about, message)
        elif kind == "registered":
            node.engine.on_registered(about)
        else:
            message(node)
        node.check()

    def _lose(self, channel: tuple[str, Any]) -> None:
        self.losses -= 1
        self.channels[channel].popleft()

    def _crash(self, name: str) -> None:
        """A node dies; the launcher sees it and stops the others."""
        self.has_crashed = self.is_ending = True
        self._node(name).is_dead = True
        self._tell_all(_stop)

    def _shut_down(self) -> None:
        self.is_ending = True
        for name in self.nodes:
            places = tuple(self.project.last_round.get(name, ()))
            self.put(("to node", name), functools.partial(_drain, places))
        self.probing.drain((), 0.0)

    def _probe(self) -> None:
        self.now_s += 1e3  # long after the last one
        self.probing.check(self.now_s, 0.0)

    # the launcher

    @property
    def is_ready(self) -> bool:
        """Whether every node has told that it has initialised as far as it can alone."""
        return all(node.is_ready for node in self.nodes.values())

    def look_at_start(self) -> None:
        """A node has become ready: the last one lets all begin."""
        if self.is_ready:
            self._tell_all(_activate)

    def _to_all(self, message: Message) -> None:
        assert isinstance(message, Probe)
        self._tell_all(_Question(message.number))

    def _tell_all(self, message: Callable[[ModelNode], None]) -> None:
        for name in self.nodes:
            self.put(("to node", name), message)

    def _must_shut_down(self) -> bool:
        """Whether it has gone on for so long that nothing new would come of it."""
        counts = [count for node in self.nodes.values() for count in node.numbers.values()]
        return (
            self.project.shuts_down
            and not self.is_ending
            and self._all_run()
            and max(counts, default=0) >= _LONGEST
        )

    def _orders_that_are_late(self) -> list[tuple[Any, ...]]:
        """To drain: while a node has not heard of it, a loop goes round for ever."""
        sent = [count for node in self.nodes.values() for count in node.numbers.values()]
        if not self.is_ending or max(sent, default=0) < 2 * _LONGEST:
            return []
        channels = [("to node", name) for name in self.nodes]
        return [("deliver", channel) for channel in channels if self.channels.get(channel)]

    def _all_run(self) -> bool:
        return all(node.engine.is_running for node in self.nodes.values())

    def _may_probe(self) -> bool:
        return (
            not self.has_crashed
            and self.probing.verdict is Verdict.UNDECIDED
            and not any(self.channels.get(("to node", name)) for name in self.nodes)
        )

    def take_answer(self, answer: Probed) -> None:
        """A node has answered a probe."""
        self.probing.add(answer, self.now_s)
        if self.probing.verdict is Verdict.DRAINED and not self.is_drained:
            self._end_drained()

    def _end_drained(self) -> None:
        """The rule of a drained end: nothing reliable is under way, or could be started on."""
        self.is_drained = True
        for c in self.project.connections:
            if c.is_reliable and (self.channels.get(("data", c)) or self.channels.get(("ack", c))):
                raise Broken(f"{c}: it is drained, and something is under way")
        for name, node in self.nodes.items():
            if node.engine.has_startable_packet:
                raise Broken(f"it is drained, and {name} could start on a packet")
        self._tell_all(_stop)

    def _taken(self, c: Connection) -> int:
        origin = f"{c.source_node}.{c.source_output}"
        node = self.nodes[c.destination_node]
        takers = [spec.name for spec in self.project.plugins[node.name]
                  if c.destination_input in [port.name for port in spec.inputs]]  # fmt: skip
        return min(
            (node.last_taken.get((hook, c.destination_input, origin), 0) for hook in takers),
            default=self.project.goal,
        )


def _activate(node: ModelNode) -> None:
    node.engine.activate()
    node.engine.on_timer()


def _drain(places: Sequence[int], node: ModelNode) -> None:
    node.in_loop = [node.engine.all_hooks[place].name for place in places]
    node.last_round = [*node.in_loop]
    node.engine.drain(places)


def _stop(node: ModelNode) -> None:
    node.engine.stop_hooks()
    node.is_over = True


@dataclass(frozen=True)
class _Question:
    """A probe, which a node answers between two events."""

    _number: int

    def __call__(self, node: ModelNode) -> None:
        # The launcher judges when it has all answers, in whichever order they come.
        node.world.take_answer(_answer_of(node, self._number))


def _answer_of(node: ModelNode, number: int) -> Probed:
    """What a node answers to a probe, without the figures that only people read."""
    engine = node.engine
    windows, subscriptions = engine.send_windows.values(), engine.subscriptions.values()
    probe = NodeProbe(
        sent={str(each.connection): (each.sent, each.acknowledged) for each in windows},
        received={each.name: (each.received, each.acknowledged) for each in subscriptions},
        is_startable=engine.has_startable_packet,
    )
    return Probed(number, {node.name: probe})
