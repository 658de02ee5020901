"""Replay of an engine from its event log.

An engine gets the events of a recorded run again, in their order. Neighbours, timers and the wall
clock are those of the log. The plugin runs anew and may differ from the log: then the replay ends
and names the difference.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple, Protocol

from neuros.engine.engine import Effects, Engine
from neuros.engine.event_log import CALLBACK, EventKind, entry_of, parts_of
from neuros.engine.hook import Hook
from neuros.engine.node_ports import PacketType
from neuros.hooks import HookSpec
from neuros.project.model import Connection, Node

_NO_START = -1


class Event(NamedTuple):
    """An event, and the readings of the clock, and of hooks, up to the next event.

    ``limit``: starts of hooks after which arrivals ended the pass; ``None``: nothing ended it.
    """

    kind: EventKind
    place: int
    position: int
    readings: list[int]
    hook_readings: list[int]
    limit: int | None = None


def events_of(event_log: Iterable[int]) -> Iterator[Event]:
    """The events of a log; the first, ``BEGIN``, has the readings before all events."""
    event = Event(EventKind.BEGIN, 0, 0, [], [])
    numbers = iter(event_log)
    for number in numbers:
        if number >= 0:
            event.readings.append(number)
            continue
        kind, place, position = parts_of(number)
        if kind is EventKind.DEFERRED:
            event = event._replace(limit=position)
        elif kind is EventKind.READING:
            event.hook_readings.extend(islice(numbers, 1))  # none where the log was cut off
        elif kind not in (EventKind.HOOK, EventKind.CALLBACK):
            yield event
            event = Event(kind, place, position, [], [])
    yield event


def starts_of(event_log: Iterable[int]) -> Iterator[int]:
    """The started hooks, as places in the order of declaration."""
    parts = (parts_of(number) for number in event_log if number < 0)
    return (place for kind, place, _ in parts if kind is EventKind.HOOK)


def is_whole(event_log: Iterable[int]) -> bool:
    """Whether a log reaches the end of the run."""
    return entry_of(EventKind.STOP) in event_log


def callbacks_in(event_log: array[int]) -> int:
    """How many callbacks of ROS entities of the plugin ran."""
    return event_log.count(CALLBACK)


def is_understood(event_log: Iterable[int]) -> bool:
    """Whether every entry is of a known kind."""
    try:
        return all(parts_of(number) for number in event_log if number < 0)
    except ValueError:
        return False


class ReplayOver(Exception):
    """A hook would start after the last one of the log."""


class ReplayParted(Exception):
    """The replay cannot go on as the run did; the text says why."""


class RecordedArrivals(Protocol):
    """The packets of a recorded run, which the event log does not hold."""

    def packet(self, key: Connection | str, number: int) -> Any:
        """The ``number``-th packet (from 1) of a connection or input; raises ``ReplayOver``."""

    def offer(self) -> None:
        """Wait until the plugin's thread offers packets; raises ``ReplayParted``."""


class Script:
    """The position of a replay in its event log.

    Attributes:
        started: how many hooks have started.
        deliveries: packets of the node to itself that have not arrived.
        loop_back: the posted one, if any.
    """

    def __init__(self, event_log: array[int]) -> None:
        self._events = events_of(event_log)
        self._starts = starts_of(event_log)
        self._next = next(self._starts, _NO_START)
        self._readings: Iterator[int] = iter(next(self._events).readings)
        self._hook_readings: Iterator[int] = iter(())
        self._now_ns = 0
        self._limit: int | None = None
        self._in_event = 0
        self.started = 0
        self.deliveries: deque[Callable[[], None]] = deque()
        self.loop_back: Callable[[], None] | None = None

    def clock(self) -> int:
        """The next reading of the clock in the log, or else the last one."""
        self._now_ns = next(self._readings, self._now_ns)
        return self._now_ns

    def reading(self, value: int) -> int:
        """The next reading of a hook in the log; ``value`` for one that a changed plugin adds."""
        return next(self._hook_readings, value)

    def may_start(self) -> bool:
        """Whether a ready hook starts now, and not after further arrivals."""
        return self._limit is None or self._in_event < self._limit

    def record_start(self) -> None:
        """Count a start of a hook, or packets sent from a thread of the plugin."""
        self._in_event += 1

    def events(self) -> Iterator[Event]:
        for event in self._events:
            self._readings = iter(event.readings)
            self._hook_readings = iter(event.hook_readings)
            self._limit, self._in_event = event.limit, 0
            yield event

    @property
    def expects_start(self) -> bool:
        """Whether the log has further starts of hooks."""
        return self._next != _NO_START

    def check_start(self, place: int, names: Mapping[int, str]) -> None:
        """Check the start of a hook against the log.

        Raises:
            ReplayOver: if the log has no further start.
            ReplayParted: if another hook started in the run.
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
    """An engine that starts the hooks of the log only; its clock is the script's."""

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
        self.reading = script.reading  # type: ignore[method-assign]
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
        self._script.record_start()
        super()._run(hook)


class Player:
    """Plays a script to a node, event by event.

    Args:
        inbox: the node, which hands the events to its engine.
    """

    def __init__(
        self, script: Script, engine: Engine, inbox: Any, source: RecordedArrivals
    ) -> None:
        self._script, self._engine, self._inbox, self._source = script, engine, inbox, source
        self._arrived: dict[Connection | str, int] = {}
        self._last_round: list[int] = []
        ends = [*engine.subscriptions, *engine.send_windows]
        self._connections = {key.index: key for key in ends if isinstance(key, Connection)}

    def play(self, event: Event) -> None:
        """Play an event.

        Raises:
            ReplayOver, ReplayParted: if the replay ends here.
        """
        kind = event.kind
        if kind is EventKind.PACKET:
            connection = self._connections[event.place]
            if connection.source_node != connection.destination_node:
                self._inbox.on_packet(connection, self._arriving(connection))
            elif self._script.deliveries:
                self._script.deliveries.popleft()()
        elif kind is EventKind.ACKNOWLEDGEMENT:
            connection = self._connections[event.place]
            # A changed plugin may have sent less.
            position = min(event.position, self._engine.send_windows[connection].sent)
            self._inbox.on_acknowledgement(connection, position)
        elif kind is EventKind.EXTERNAL:
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
        elif kind is EventKind.START:
            self._inbox.start(awaits_others=bool(event.place))
        elif kind is EventKind.STEP:
            self._inbox.step(event.position, is_driven=bool(event.place))
        elif kind is EventKind.LAST_ROUND:
            if event.place < len(self._engine.all_hooks):  # a changed plugin may have less
                self._last_round.append(event.place)
        elif kind is EventKind.DRAIN:
            self._inbox.drain(self._last_round)
        else:
            {
                EventKind.ACTIVATE: self._inbox.activate,
                EventKind.TIMER: self._inbox.on_timer,
                EventKind.PAUSE: self._inbox.pause,
                EventKind.RESUME: self._inbox.resume,
                EventKind.STOP: self._inbox.stop,
            }[kind]()

    def _arriving(self, key: Connection | str) -> Any:
        number = self._arrived[key] = self._arrived.get(key, 0) + 1
        return self._source.packet(key, number)
