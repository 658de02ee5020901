"""Several engines joined by a network that delays: deterministic, and with no real time in it.

Packets, acknowledgements and registrations of a connection each keep their order and take as long
as the test says; so do hooks. Every node has a clock, a queue of events, and one thing at a time.
"""

from __future__ import annotations

import functools
import heapq
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from engine_bench import Clock, node_for

from neuros.engine.engine import Engine
from neuros.engine.hook import Hook
from neuros.hooks import HookSpec
from neuros.project.model import Connection, Port

Event = Callable[[], None]


class NetworkNode:
    """One node: the effects of its engine, and its queue of events."""

    def __init__(self, network: Network, name: str, specs: Sequence[HookSpec]) -> None:
        self.network = network
        self.name = name
        self.clock = Clock(0)
        self.events: deque[Event] = deque()
        self.last_turn = 0
        self.runs: list[tuple[str, tuple[Any, ...]]] = []
        self.taken: dict[tuple[Connection, str], list[Any]] = {}
        connections = [
            c for c in network.connections if name in (c.source_node, c.destination_node)
        ]
        self.engine = Engine(
            node_for(name, specs, connections), connections, specs, self, self.clock
        )

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        self.runs.append((hook.name, tuple(arguments)))
        self.clock.now_ns += self.network.delay_ns()
        return hook.spec.function(self, *arguments)

    def sender(self, port: Port, connections: Sequence[Connection]) -> Callable[[Any], None]:
        assert port.external_topic is None
        return functools.partial(self._send, connections)

    def _send(self, connections: Sequence[Connection], packet: Any) -> None:
        for c in connections:
            self.network.sequences[c].append(packet)
            receiver = self.network.nodes[c.destination_node]
            arrive = functools.partial(receiver.engine.on_packet, c, packet)
            self.network.deliver(self, receiver, ("data", c), arrive)

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return functools.partial(self._acknowledge, connection)

    def _acknowledge(self, connection: Connection, position: int) -> None:
        sender = self.network.nodes[connection.source_node]
        self.network.deliver(
            self,
            sender,
            ("ack", connection),
            functools.partial(sender.engine.on_acknowledgement, connection, position),
        )

    def give_way(self) -> None: ...
    def note_ready(self) -> None: ...

    def has_taken_in(self) -> bool:
        return True

    def post(self, event: Event) -> None:
        self.events.append(event)

    post_loop_back = post

    def copy_to_itself(self, connection: Any, packet: Any) -> Any:
        return packet

    @property
    def next_event_ns(self) -> int | None:
        """When it handles its next event, or timer."""
        if self.events:
            return self.clock.now_ns
        due_ns = self.engine.next_due_ns
        return None if due_ns is None else max(due_ns, self.clock.now_ns)

    def handle_event(self) -> None:
        if self.events:
            self.events.popleft()()
        else:
            self.clock.now_ns = max(self.clock.now_ns, self.engine.next_due_ns or 0)
            self.engine.on_timer()


class Network:
    """A project of several nodes.

    Args:
        plugins: the hooks by node.
        delays_ns: how long hooks and deliveries take, in the order in which they are asked for;
            repeated for ever.
        after_event: called after each event of a node, for invariants.
    """

    def __init__(
        self,
        connections: Iterable[Connection],
        plugins: Mapping[str, Sequence[HookSpec]],
        delays_ns: Sequence[int] = (0,),
        after_event: Callable[[Network], None] = lambda network: None,
    ) -> None:
        self.connections = list(connections)
        self.sequences: dict[Connection, list[Any]] = {c: [] for c in self.connections}
        self._delays = itertools.cycle(delays_ns)
        self._after_event = after_event
        self._in_transit: list[tuple[int, int, NetworkNode, Event]] = []
        self._last_arrival: dict[object, int] = {}
        self._numbers = itertools.count()
        self.nodes = {name: NetworkNode(self, name, specs) for name, specs in plugins.items()}
        for node in self.nodes.values():
            self.deliver(node, node, ("start", node.name), node.engine.start)
            for c in node.engine.send_windows:
                receiver = self.nodes[c.destination_node]
                self.deliver(
                    receiver, node, ("reg", c), functools.partial(node.engine.on_registered, c)
                )

    def delay_ns(self) -> int:
        return next(self._delays)

    def deliver(self, sender: NetworkNode, to: NetworkNode, channel: object, event: Event) -> None:
        """An event reaches a node later, after all that were sent on its channel before."""
        arrival_ns = max(sender.clock.now_ns + self.delay_ns(), self._last_arrival.get(channel, 0))
        self._last_arrival[channel] = arrival_ns
        heapq.heappush(self._in_transit, (arrival_ns, next(self._numbers), to, event))

    def step(self) -> bool:
        """The next thing happens; False if nothing can happen any more."""
        ready = [
            (at_ns, node.last_turn, place, node)
            for place, node in enumerate(self.nodes.values())
            if (at_ns := node.next_event_ns) is not None
        ]
        at_ns, _, _, node = min(ready, default=(None, 0, 0, None))
        if self._in_transit and (at_ns is None or self._in_transit[0][0] <= at_ns):
            arrival_ns, _, receiver, event = heapq.heappop(self._in_transit)
            receiver.clock.now_ns = max(receiver.clock.now_ns, arrival_ns)
            receiver.events.append(event)
            return True
        if node is None:
            return False
        node.last_turn = next(self._numbers)
        node.handle_event()
        self._after_event(self)
        return True

    def run(self, steps: int) -> bool:
        """Let things happen; True if it has come to rest before that many."""
        return any(not self.step() for _ in range(steps))

    # what the specification speaks of

    def runs(self, node: str, hook: str) -> list[tuple[Any, ...]]:
        return [arguments for name, arguments in self.nodes[node].runs if name == hook]

    def sender(self, c: Connection) -> Any:
        return self.nodes[c.source_node].engine.send_windows[c]

    def receiver(self, c: Connection) -> Any:
        return self.nodes[c.destination_node].engine.subscriptions[c]

    @property
    def is_wakeable(self) -> bool:
        return any(node.engine.is_wakeable for node in self.nodes.values())

    @property
    def has_something_under_way(self) -> bool:
        return bool(self._in_transit) or any(node.events for node in self.nodes.values())
