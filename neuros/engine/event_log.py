"""The event log of an engine, an array of integers, from which a run is replayed.

The decisions of an engine follow from its events and, if hooks have a period, from the readings of
its clock; what hooks compute may follow from readings of their own (:meth:`Engine.reading`). The
log holds all of them in their order, and each start of a hook, for a check of the replay. A
negative entry is an event: its complement holds the kind in 5 bits, a place in 20 and a position in
38. Other entries are readings of the clock in ns, or that of a hook, after ``READING``. An entry
costs some 0.1 us.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any

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
        self.event_log = log = array("q")
        self._record = log.append
        record = self._record

        def recorded_clock() -> int:
            now_ns = clock()
            record(now_ns)
            return now_ns

        def recorded_has_taken_in() -> bool:
            is_in = effects.has_taken_in()
            if not is_in:
                record(entry_of(EventKind.DEFERRED, position=self._starts))
            return is_in

        has_ticks = any(spec.period_s is not None for spec in specs)
        own_clock = recorded_clock if has_ticks else clock
        super().__init__(node, connections, specs, effects, own_clock, packet_types)
        self._has_taken_in = recorded_has_taken_in
        self._starts = 0
        self._hook_entries = {
            hook: entry_of(EventKind.HOOK, place) for place, hook in enumerate(self.all_hooks)
        }
        self._packet_entries: dict[Connection | str, int] = {
            connection: entry_of(EventKind.PACKET, connection.index) for connection in connections
        } | {
            port.name: entry_of(EventKind.EXTERNAL, place) for place, port in enumerate(node.inputs)
        }
        self._acknowledgement_entries = {
            connection: entry_of(EventKind.ACKNOWLEDGEMENT, connection.index)
            for connection in connections
        }

    def start(self, *, awaits_others: bool = False) -> None:
        self._record(entry_of(EventKind.START, int(awaits_others)))
        super().start(awaits_others=awaits_others)

    def activate(self) -> None:
        self._record(entry_of(EventKind.ACTIVATE))
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
        self._record(entry_of(EventKind.REGISTERED, connection.index))
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
            self._record(entry_of(EventKind.LAST_ROUND, place))
        self._record(entry_of(EventKind.DRAIN))
        super().drain(last_round)

    def pause(self) -> None:
        self._record(entry_of(EventKind.PAUSE))
        super().pause()

    def resume(self) -> None:
        self._record(entry_of(EventKind.RESUME))
        super().resume()

    def step(self, count: int, *, is_driven: bool) -> None:
        self._record(entry_of(EventKind.STEP, int(is_driven), count))
        super().step(count, is_driven=is_driven)

    def reading(self, value: int) -> int:
        self._record(READING)
        self._record(value)
        return value

    def note_callback(self) -> None:
        self._record(CALLBACK)

    def stop_hooks(self) -> None:
        super().stop_hooks()
        self._record(entry_of(EventKind.STOP))

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


def entry_of(kind: EventKind, place: int = 0, position: int = 0) -> int:
    return ~(kind | place << _KIND_BITS | position << _POSITION_SHIFT)


def parts_of(entry: int) -> tuple[EventKind, int, int]:
    """Kind, place and position of an entry. Raises ``ValueError`` for one of no known kind."""
    value = ~entry
    place = value >> _KIND_BITS & (1 << _PLACE_BITS) - 1
    return EventKind(value & (1 << _KIND_BITS) - 1), place, value >> _POSITION_SHIFT


_TIMER, _LOOP_BACK, _OFFER = map(entry_of, (EventKind.TIMER, EventKind.LOOP_BACK, EventKind.OFFER))
READING, CALLBACK = map(entry_of, (EventKind.READING, EventKind.CALLBACK))
