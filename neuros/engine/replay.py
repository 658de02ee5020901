"""Replays an event log: an engine gets the events of a recorded run again, in their order.

Neighbours, timers and the wall clock are those of the log. The plugin runs anew, so it may differ
from the log: then the replay says where, and guesses nothing.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from neuros.engine.engine import Effects, Engine
from neuros.engine.event_log import Event, EventKind, events_of, starts_of
from neuros.engine.hook import Hook
from neuros.engine.node_ports import PacketType
from neuros.hooks import HookSpec
from neuros.project.model import Connection, Node

_NO_START = -1


class ReplayOver(Exception):
    """A hook would start after the last one of the log."""


class ReplayParted(Exception):
    """The replay cannot go on as the run did; the text says why."""


class Source(Protocol):
    """The packets of a recorded run, which the event log does not hold."""

    def packet(self, key: Connection | str, number: int) -> Any:
        """The packet that arrived as the ``number``-th (from 1) there; raises ``ReplayOver``."""

    def offer(self) -> None:
        """Have the plugin's thread offer packets, as soon as it does; raises ``ReplayParted``."""


class Inbox(Protocol):
    """The node that takes the events to its engine."""

    def start(self) -> None: ...
    def on_packet(self, connection: Connection, packet: Any) -> None: ...
    def on_external_packet(self, port: Any, packet: Any) -> None: ...
    def on_acknowledgement(self, connection: Connection, position: int) -> None: ...
    def on_registered(self, connection: Connection) -> None: ...
    def on_timer(self) -> None: ...
    def drain(self, last_round: Sequence[int] = ()) -> None: ...
    def pause(self) -> None: ...
    def resume(self) -> None: ...
    def step(self, count: int, *, is_driven: bool) -> None: ...
    def stop(self) -> None: ...


class Script:
    """The position of a replay in its event log.

    Attributes:
        started: how many hooks have started.
        deliveries: packets of the node to itself that are on their way.
        loop_back: the one that is on its way, if any.
    """

    def __init__(self, event_log: array[int]) -> None:
        self._events = events_of(event_log)
        self._starts = starts_of(event_log)
        self._next = next(self._starts, _NO_START)
        self._readings: Iterator[int] = iter(next(self._events).readings)
        self._now_ns = 0
        self._limit: int | None = None
        self._in_event = 0
        self.started = 0
        self.deliveries: deque[Callable[[], None]] = deque()
        self.loop_back: Callable[[], None] | None = None

    def clock(self) -> int:
        """The reading of the clock at this point, or else the last one."""
        self._now_ns = next(self._readings, self._now_ns)
        return self._now_ns

    def may_start(self) -> bool:
        """Whether a ready hook starts now, rather than after what had arrived at this point."""
        return self._limit is None or self._in_event < self._limit

    def note_start(self) -> None:
        """A hook starts, or packets from a thread of the plugin leave."""
        self._in_event += 1

    def events(self) -> Iterator[Event]:
        """The events, in their order."""
        for event in self._events:
            self._readings = iter(event.readings)
            self._limit, self._in_event = event.limit, 0
            yield event

    @property
    def expects_start(self) -> bool:
        """Whether the log has further starts of hooks."""
        return self._next != _NO_START

    def check_start(self, place: int, names: Mapping[int, str]) -> None:
        """A hook is about to start: whether it did in the log, too.

        Raises:
            ReplayOver, ReplayParted: if not.
        """
        if self._next == _NO_START:
            raise ReplayOver
        if place != self._next:
            expected = names.get(self._next, "one that the plugin no longer has")
            raise ReplayParted(
                f"start {self.started + 1} of a hook is of '{names[place]}', but was of"
                f" '{expected}' in the run"
            )
        self.started += 1
        self._next = next(self._starts, _NO_START)


class ReplayedEngine(Engine):
    """Starts hooks where the log has them start, and nowhere else; its clock is the script's."""

    def __init__(
        self,
        script: Script,
        node: Node,
        connections: Sequence[Connection],
        specs: Sequence[HookSpec],
        effects: Effects,
        clock: Callable[[], int],
        packet_types: Mapping[str, PacketType] | None = None,
    ) -> None:
        super().__init__(node, connections, specs, effects, script.clock, packet_types)
        self._has_taken_in = script.may_start
        self._script = script
        self._places = {hook: place for place, hook in enumerate(self.all_hooks)}
        self._names = {place: hook.name for hook, place in self._places.items()}
        self.has_offer = False

    def offer(self, packets: Mapping[str, Any], accepted: Callable[[], None]) -> Callable[[], None]:
        self.has_offer = True
        return super().offer(packets, accepted)

    def _run(self, hook: Hook) -> None:
        place = self._places.get(hook)
        if place is not None:
            self._script.check_start(place, self._names)
        self._script.note_start()
        super()._run(hook)


class Player:
    """Takes a node through a script, event by event."""

    def __init__(self, script: Script, engine: Engine, inbox: Inbox, source: Source) -> None:
        self._script, self._engine, self._inbox, self._source = script, engine, inbox, source
        self._arrived: dict[Connection | str, int] = {}
        self._last_round: list[int] = []
        ends = [*engine.subscriptions, *engine.send_windows]
        self._connections = {key.index: key for key in ends if isinstance(key, Connection)}

    def play(self, event: Event) -> None:
        """Let an event happen.

        Raises:
            ReplayOver, ReplayParted: if the replay ends with it.
        """
        kind = event.kind
        if kind is EventKind.PACKET:
            self._packet(self._connections[event.place])
        elif kind is EventKind.ACKNOWLEDGEMENT:
            connection = self._connections[event.place]
            # A plugin that was changed may have sent less.
            position = min(event.position, self._engine.send_windows[connection].sent)
            self._inbox.on_acknowledgement(connection, position)
        elif kind is EventKind.HEARD:
            port = self._engine.node.inputs[event.place]
            self._inbox.on_external_packet(port, self._arriving(port.name))
        elif kind is EventKind.REGISTERED:
            self._inbox.on_registered(self._connections[event.place])
        elif kind is EventKind.LOOP_BACK:
            loop_back, self._script.loop_back = self._script.loop_back, None
            if loop_back is not None:
                loop_back()
        elif kind is EventKind.OFFER:
            self._source.offer()
        elif kind is EventKind.STEP:
            self._inbox.step(event.position, is_driven=bool(event.place))
        elif kind is EventKind.LAST_ROUND:
            if event.place < len(self._engine.all_hooks):  # a plugin that was changed may have less
                self._last_round.append(event.place)
        elif kind is EventKind.DRAIN:
            self._inbox.drain(self._last_round)
        else:
            {
                EventKind.START: self._inbox.start,
                EventKind.TIMER: self._inbox.on_timer,
                EventKind.PAUSE: self._inbox.pause,
                EventKind.RESUME: self._inbox.resume,
                EventKind.STOP: self._inbox.stop,
            }[kind]()

    def _packet(self, connection: Connection) -> None:
        if connection.source_node != connection.destination_node:
            self._inbox.on_packet(connection, self._arriving(connection))
        elif self._script.deliveries:
            self._script.deliveries.popleft()()

    def _arriving(self, key: Connection | str) -> Any:
        number = self._arrived[key] = self._arrived.get(key, 0) + 1
        return self._source.packet(key, number)
