"""One engine on a workbench: every event comes from the test, every effect is written down."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from neuros.engine.engine import Engine
from neuros.engine.hook import Hook
from neuros.engine.node_ports import PacketType
from neuros.hooks import (
    HookSpec,
    Optional,
    hook_specs_of,
    neuros_finalise,
    neuros_function,
    neuros_initialise,
    neuros_tick,
)
from neuros.project.model import Connection, Node, Port

SECOND = 1_000_000_000


class Clock:
    """A monotonic clock that goes when it is told to."""

    def __init__(self, now_ns: int = 1_000 * SECOND) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns

    def advance(self, seconds: float) -> None:
        self.now_ns += round(seconds * SECOND)


def wire(
    text: str, discard_limit: int | None = None, queue_size: int = 1, index: int = 0
) -> Connection:
    """A connection from ``"a.out -> b.in"``."""
    source, destination = text.split(" -> ")
    return Connection(*source.split("."), *destination.split("."), discard_limit, queue_size, index)


def _mark(decorator: Callable[..., Any], name: str, returns: Any) -> HookSpec:
    def function(node: Any, *inputs: Any) -> Any:
        return returns(*inputs) if callable(returns) else returns

    function.__name__ = name
    (spec,) = hook_specs_of({name: decorator(function)})
    return spec


def function(name: str, inputs: Any = None, outputs: Any = None, returns: Any = None) -> HookSpec:
    """A function hook that returns ``returns``, or calls it with its inputs."""
    return _mark(neuros_function(inputs, outputs), name, returns)


def initialise(name: str, inputs: Any = None, outputs: Any = None, returns: Any = None) -> HookSpec:
    return _mark(neuros_initialise(inputs, outputs), name, returns)


def tick(
    name: str, seconds: float, inputs: Any = None, outputs: Any = None, returns: Any = None
) -> HookSpec:
    return _mark(neuros_tick(seconds, inputs, outputs), name, returns)


def sim_tick(
    name: str, seconds: float, inputs: Any = None, outputs: Any = None, returns: Any = None
) -> HookSpec:
    decorator = neuros_tick(sim_seconds=seconds, inputs=inputs, outputs=outputs)
    return _mark(decorator, name, returns)


def finalise(name: str) -> HookSpec:
    return _mark(neuros_finalise(), name, None)


def node_for(
    name: str,
    specs: Iterable[HookSpec],
    connections: Iterable[Connection],
    external_inputs: Sequence[str] = (),
    external_outputs: Sequence[str] = (),
) -> Node:
    """A node with every port that its hooks and connections name."""
    connections = list(connections)
    inputs = {c.destination_input: None for c in connections if c.destination_node == name}
    outputs = {c.source_output: None for c in connections if c.source_node == name}
    for spec in specs:
        inputs.update(dict.fromkeys(port.name for port in spec.inputs))
        outputs.update(dict.fromkeys(port.name for port in spec.outputs))
    inputs.update(dict.fromkeys(external_inputs))
    outputs.update(dict.fromkeys(external_outputs))
    return Node(
        name,
        "neuros_python",
        Path("/project/plugin.py"),
        inputs=tuple(_port(each, each in external_inputs) for each in inputs),
        outputs=tuple(_port(each, each in external_outputs) for each in outputs),
    )


def _port(name: str, is_external: bool) -> Port:
    return Port(name, "std_msgs/msg/String", f"/{name}" if is_external else None)


class Bench:
    """The node ``node`` with these hooks and connections, by default started and registered.

    Attributes:
        calls: ``(hook, inputs)`` in order; :attr:`ran` is the names alone.
        sent: ``(connection, packet)`` to other nodes; ``external`` the same with topics' ports.
        acknowledged: ``(connection, position)`` sent to other nodes.
        log: all these together.
        is_taken_in: whether all that has reached the node has been handled.
    """

    def __init__(
        self,
        *specs: HookSpec,
        connections: Sequence[Connection] = (),
        external_inputs: Sequence[str] = (),
        external_outputs: Sequence[str] = (),
        packet_types: dict[str, type] | None = None,
        check: Callable[[Any], Any] = lambda packet: packet,
        is_started: bool = True,
        is_registered: bool = True,
        make_engine: Callable[..., Engine] = Engine,
    ) -> None:
        self.clock = Clock()
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.sent: list[tuple[str, Any]] = []
        self.external: list[tuple[str, Any]] = []
        self.acknowledged: list[tuple[str, int]] = []
        self.log: list[tuple[Any, ...]] = []
        self.during_call: Callable[[], None] | None = None
        self.hook_s = 0.0
        self.is_taken_in = True
        self.ways_given = 0
        self.told_ready = 0
        self.posted: deque[tuple[str, Callable[[], None]]] = deque()
        node = node_for("node", specs, connections, external_inputs, external_outputs)
        self.by_name: dict[str, Any] = {str(c): c for c in connections}
        types = {name: PacketType(kind, check) for name, kind in (packet_types or {}).items()}
        self.engine = make_engine(node, connections, specs, self, self.clock, types)
        if is_registered:
            for connection in self.engine.send_windows:
                self.engine.on_registered(connection)
        if is_started:
            self.engine.start()

    # what the test does

    def packet(self, connection: str, packet: Any = "packet") -> list[str]:
        """A packet arrives on a connection or external input; returns the hooks that ran."""
        return self._ran(
            lambda: self.engine.on_packet(self.by_name.get(connection, connection), packet)
        )

    def acknowledge_to_node(self, connection: str, position: int) -> list[str]:
        return self._ran(lambda: self.engine.on_acknowledgement(self.by_name[connection], position))

    def activate(self) -> list[str]:
        """Every node is ready, and the first event after that comes."""
        self.engine.activate()
        return self._ran(self.engine.on_timer)

    def register(self, connection: str) -> list[str]:
        return self._ran(lambda: self.engine.on_registered(self.by_name[connection]))

    def pass_time(self, seconds: float) -> list[str]:
        """Time passes; the timer fires at the end if it is due by then."""
        self.clock.advance(seconds)
        due_ns = self.engine.next_due_ns
        if due_ns is None or due_ns > self.clock.now_ns:
            return []
        return self._ran(self.engine.on_timer)

    def posted_event(self) -> list[str]:
        """The oldest posted event is handled."""
        _, event = self.posted.popleft()
        return self._ran(event)

    def settle(self, limit: int = 100) -> list[str]:
        """All posted events, and those that they post, are handled."""
        ran = []
        while self.posted and limit:
            ran += self.posted_event()
            limit -= 1
        return ran

    def _ran(self, event: Callable[[], object]) -> list[str]:
        before = len(self.calls)
        event()
        return [name for name, _ in self.calls[before:]]

    # what it sees

    @property
    def ran(self) -> list[str]:
        return [name for name, _ in self.calls]

    @property
    def waiting(self) -> list[str]:
        """What is posted: ``"own packet"`` or ``"loop-back"``."""
        return [kind for kind, _ in self.posted]

    def hook(self, name: str) -> Hook:
        (hook,) = (each for each in self.engine.all_hooks if each.name == name)
        return hook

    # Effects

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        self.calls.append((hook.name, tuple(arguments)))
        self.log.append(("start", hook.name))
        self.clock.advance(self.hook_s)
        if self.during_call:
            self.during_call()
        result = hook.spec.function(self, *arguments)
        self.log.append(("end", hook.name))
        return result

    def sender(self, port: Port, connections: Sequence[Connection]) -> Callable[[Any], None]:
        def send(packet: Any) -> None:
            if port.external_topic is not None:
                self.external.append((port.name, packet))
            for connection in connections:
                self.sent.append((str(connection), packet))
                self.log.append(("send", str(connection)))

        return send

    def give_way(self) -> None:
        self.ways_given += 1

    def note_ready(self) -> None:
        self.told_ready += 1

    def has_taken_in(self) -> bool:
        return self.is_taken_in

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        def acknowledge(position: int) -> None:
            self.acknowledged.append((str(connection), position))
            self.log.append(("acknowledge", str(connection), position))

        return acknowledge

    def post(self, event: Callable[[], None]) -> None:
        self.posted.append(("own packet", event))

    def post_loop_back(self, event: Callable[[], None]) -> None:
        self.posted.append(("loop-back", event))

    def copy_to_itself(self, connection: Any, packet: Any) -> Any:
        return ("copy of", packet)


__all__ = [
    "SECOND",
    "Bench",
    "Clock",
    "Optional",
    "finalise",
    "function",
    "initialise",
    "node_for",
    "sim_tick",
    "tick",
    "wire",
]
