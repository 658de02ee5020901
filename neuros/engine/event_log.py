"""The event log of an engine, an array of integers, and its replay.

The decisions of an engine follow from its events and, if hooks have a period, from the readings of
its clock; what hooks compute may follow from readings of their own (:meth:`Engine.reading`). The
log holds all of them in their order, and each start of a hook, for a check of the replay. A
negative entry is an event: its complement holds the kind in 5 bits, a place in 20 and a position in
38. Other entries are readings of the clock in ns, or that of a hook, after ``READING``. An entry
costs some 0.1 us.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from itertools import islice
from typing import Any, NamedTuple, Protocol

from neuros.engine.engine import Effects, Engine
from neuros.engine.hook import Hook
from neuros.engine.node_ports import PacketType
from neuros.hooks import HookSpec
from neuros.project.model import Connection, Node

_KIND_BITS, _PLACE_BITS = 5, 20
_POSITION_SHIFT = _KIND_BITS + _PLACE_BITS


class EventKind(IntEnum):
    """The kinds of entries; ``place`` and ``position`` where they have one."""

    BEGIN = 0  # never written: holds the readings before the first event
    START = 1  # place: 1 if the node waits until all others are ready
    PACKET = 2  # place: index of the connection
    EXTERNAL = 3  # a packet on an external topic; place: of the input, in the node
    ACKNOWLEDGEMENT = 4  # place: index of the connection; position
    REGISTERED = 5  # place: index of the connection
    TIMER = 6
    LOOP_BACK = 7
    OFFER = 8
    DRAIN = 9
    STOP = 10  # no further hook starts: the last entry of a whole log
    HOOK = 11  # place: of the starting hook, in the order of declaration
    PAUSE = 12
    RESUME = 13
    STEP = 14  # place: 1 if a node drives the project; position: count
    DEFERRED = 15  # the pass ended before its time for arrivals; position: hooks started in it
    LAST_ROUND = 16  # before DRAIN; place: of a hook that starts at most once more
    ACTIVATE = 17
    READING = 18  # by a hook; the next entry is the value
    CALLBACK = 19  # of a ROS entity of the plugin, which no replay can call


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


class LoggedEngine(Engine):
    """An engine that records its events in :attr:`event_log`.

    The packet log empties the array from time to time. The arguments are those of :class:`Engine`.
    """

    def __init__(
        self,
        node: Node,
        connections: Sequence[Connection],
        specs: Sequence[HookSpec],
        effects: Effects,
        clock: Callable[[], int],
        packet_types: Mapping[str, PacketType] | None = None,
    ) -> None:
        self.event_log = array("q")
        self._record = self.event_log.append
        record = self._record

        def recorded_clock() -> int:
            now_ns = clock()
            record(now_ns)
            return now_ns

        def recorded_has_taken_in() -> bool:
            is_in = effects.has_taken_in()
            if not is_in:
                record(_entry(EventKind.DEFERRED, position=self._starts))
            return is_in

        has_ticks = any(spec.period_s is not None for spec in specs)
        own_clock = recorded_clock if has_ticks else clock
        super().__init__(node, connections, specs, effects, own_clock, packet_types)
        self._has_taken_in = recorded_has_taken_in
        self._starts = 0
        self._hook_entries = {
            hook: _entry(EventKind.HOOK, place) for place, hook in enumerate(self.all_hooks)
        }
        self._packet_entries: dict[Connection | str, int] = {
            connection: _entry(EventKind.PACKET, connection.index) for connection in connections
        } | {port.name: _entry(EventKind.EXTERNAL, place) for place, port in enumerate(node.inputs)}
        self._acknowledgement_entries = {
            connection: _entry(EventKind.ACKNOWLEDGEMENT, connection.index)
            for connection in connections
        }

    def start(self, *, awaits_others: bool = False) -> None:
        self._record(_entry(EventKind.START, int(awaits_others)))
        super().start(awaits_others=awaits_others)

    def activate(self) -> None:
        self._record(_entry(EventKind.ACTIVATE))
        super().activate()

    def on_packet(self, key: Connection | str, packet: Any) -> None:
        self._record(self._packet_entries[key])
        super().on_packet(key, packet)

    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None:
        self._record(self._acknowledgement_entries[connection] - (position << _POSITION_SHIFT))
        super().on_acknowledgement(connection, position, arrival_ns)

    def on_registered(self, connection: Connection) -> None:
        self._record(_entry(EventKind.REGISTERED, connection.index))
        super().on_registered(connection)

    def on_timer(self) -> None:
        self._record(_TIMER)
        super().on_timer()

    def on_loop_back(self) -> None:
        self._record(_LOOP_BACK)
        super().on_loop_back()

    def offer(self, packets: Mapping[str, Any], accepted: Callable[[], None]) -> Callable[[], None]:
        self._record(_OFFER)
        return super().offer(packets, accepted)

    def drain(self, last_round: Sequence[int] = ()) -> None:
        for place in last_round:
            self._record(_entry(EventKind.LAST_ROUND, place))
        self._record(_entry(EventKind.DRAIN))
        super().drain(last_round)

    def pause(self) -> None:
        self._record(_entry(EventKind.PAUSE))
        super().pause()

    def resume(self) -> None:
        self._record(_entry(EventKind.RESUME))
        super().resume()

    def step(self, count: int, *, is_driven: bool) -> None:
        self._record(_entry(EventKind.STEP, int(is_driven), count))
        super().step(count, is_driven=is_driven)

    def reading(self, value: int) -> int:
        self._record(_READING)
        self._record(value)
        return value

    def note_callback(self) -> None:
        self._record(_CALLBACK)

    def stop_hooks(self) -> None:
        super().stop_hooks()
        self._record(_entry(EventKind.STOP))

    def _pass(self) -> None:
        if not self._is_passing:
            self._starts = 0
        super()._pass()

    def _run(self, hook: Hook) -> None:
        self._starts += 1
        entry = self._hook_entries.get(hook)  # packets from a plugin's thread have none
        if entry is not None:
            self._record(entry)
        super()._run(hook)


def events_of(event_log: Iterable[int]) -> Iterator[Event]:
    """The events of a log; the first, ``BEGIN``, has the readings before all events."""
    event = Event(EventKind.BEGIN, 0, 0, [], [])
    numbers = iter(event_log)
    for number in numbers:
        if number >= 0:
            event.readings.append(number)
            continue
        kind, place, position = _parts(number)
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
    for number in event_log:
        if number < 0 and (~number & _mask(_KIND_BITS)) == EventKind.HOOK:
            yield _parts(number)[1]


def is_whole(event_log: Iterable[int]) -> bool:
    """Whether a log reaches the end of the run."""
    return _entry(EventKind.STOP) in event_log


def callbacks_in(event_log: array[int]) -> int:
    """How many callbacks of ROS entities of the plugin ran."""
    return event_log.count(_CALLBACK)


def is_understood(event_log: Iterable[int]) -> bool:
    """Whether every entry is of a known kind."""
    kinds = {~number & _mask(_KIND_BITS) for number in event_log if number < 0}
    return kinds <= {*map(int, EventKind)}


def _entry(kind: EventKind, place: int = 0, position: int = 0) -> int:
    return ~(kind | place << _KIND_BITS | position << _POSITION_SHIFT)


def _parts(entry: int) -> tuple[EventKind, int, int]:
    value = ~entry
    place = value >> _KIND_BITS & _mask(_PLACE_BITS)
    return EventKind(value & _mask(_KIND_BITS)), place, value >> _POSITION_SHIFT


def _mask(bits: int) -> int:
    return (1 << bits) - 1


_TIMER, _LOOP_BACK, _OFFER = map(_entry, (EventKind.TIMER, EventKind.LOOP_BACK, EventKind.OFFER))
_READING, _CALLBACK = map(_entry, (EventKind.READING, EventKind.CALLBACK))


# ---------------------------------------------------------------------- replay
#
# An engine gets the events of a recorded run again, in their order. Neighbours, timers and the wall
# clock are those of the log. The plugin runs anew and may differ from the log: then the replay ends
# and names the difference.


_NO_START = -1


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


class EventHandler(Protocol):
    """The node, which hands the events to its engine."""

    def start(self, *, awaits_others: bool = False) -> None: ...
    def activate(self) -> None: ...
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
        """The events, in their order."""
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
    """Plays a script to a node, event by event."""

    def __init__(
        self, script: Script, engine: Engine, inbox: EventHandler, source: RecordedArrivals
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
