"""One hook of a running node: what it waits for, and what it has done."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from neuros.core.flow import Outlet
from neuros.core.inputs import InputSlot, Mailbox
from neuros.core.ticks import TickBook
from neuros.errors import HookError, WrongValue
from neuros.hooks import HookKind, HookSpec, OutputSpec
from neuros.project.model import Port

_SEVERAL = (tuple, list)  # as a union it would be made anew at each use


class PacketType(NamedTuple):
    """What a hook must return for an output.

    Attributes:
        kind: the message class.
        check: returns a packet with the values that are sent, or raises ``WrongValue``.
    """

    kind: type
    check: Callable[[Any], Any]


class Output:
    """One output of the node and the connections that it feeds.

    ``packet_type`` says what a hook must return for it, ``None`` if anything will do.
    """

    __slots__ = ("elsewhere", "outlets", "packet_type", "port", "to_itself")

    def __init__(
        self, port: Port, outlets: Sequence[Outlet], packet_type: PacketType | None
    ) -> None:
        self.port = port
        self.outlets = tuple(outlets)
        connections = [outlet.connection for outlet in outlets]
        self.to_itself = tuple(c for c in connections if c.destination_node == c.source_node)
        self.elsewhere = tuple(c for c in connections if c.destination_node != c.source_node)
        self.packet_type = packet_type


class Hook:
    """A hook and its state; readiness is kept up to date by counting, not by looking.

    Attributes:
        blocked: number of its outlets that are blocked now.
        is_due: False only for a tick between two due times, and for a source with nothing to send.
        is_enabled: whether the node's phase of life lets it run at all.
        turn: grows in the order of priority: least recently executed first.
        candidates: of the whole node, the hooks that are enabled, due and have all inputs; each
            keeps itself in there, so that no event has to look at all the others.
        executions, busy_ns: how often it ran, and for how long in all.
        ticks: the intervals between its starts, if it has a period.
    """

    __slots__ = (
        "_is_due",
        "_is_enabled",
        "_lacking",
        "_outlets",
        "_results",
        "blocked",
        "busy_ns",
        "candidates",
        "due_ns",
        "executions",
        "loops",
        "missed_ticks",
        "name",
        "outputs",
        "period_ns",
        "slots",
        "spec",
        "ticks",
        "turn",
    )

    def __init__(
        self, spec: HookSpec, slots: Sequence[InputSlot], outputs: Mapping[str, Output]
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.slots = tuple(slots)
        self.outputs = tuple(outputs[port.name] for port in spec.outputs)
        self._outlets = tuple(outlet for output in self.outputs for outlet in output.outlets)
        self._results = tuple((outputs[port.name], port.is_optional) for port in spec.outputs)
        self.blocked = 0
        self.turn = 0
        self.candidates: set[Hook] = set()
        self._is_due = spec.period_s is None
        self._is_enabled = False
        self._lacking = sum(slot.missing > 0 for slot in self.slots)
        for slot in self.slots:
            slot.hook = self
        self.executions = 0
        self.busy_ns = 0
        self.due_ns = 0
        self.missed_ticks = 0
        self.period_ns = 0 if spec.period_s is None else max(1, round(spec.period_s * 1e9))
        self.ticks = TickBook(self.period_ns) if self.period_ns else None
        self.loops = tuple(self._loops())
        for outlet in self._outlets:
            outlet.hooks.append(self)
            self.blocked += outlet.is_blocked

    @property
    def is_due(self) -> bool:
        """Whether the timer condition holds."""
        return self._is_due

    @is_due.setter
    def is_due(self, is_due: bool) -> None:
        self._is_due = is_due
        self._note()

    @property
    def is_enabled(self) -> bool:
        """Whether the phase of life lets it run."""
        return self._is_enabled

    @is_enabled.setter
    def is_enabled(self, is_enabled: bool) -> None:
        self._is_enabled = is_enabled
        self._note()

    def on_slot_complete(self) -> None:
        """One of its inputs has now what it needs."""
        self._lacking -= 1
        if not self._lacking and self._is_enabled and self._is_due:
            self.candidates.add(self)

    def on_slot_incomplete(self) -> None:
        """One of its inputs lacks something now."""
        self._lacking += 1
        self.candidates.discard(self)

    def outlets(self) -> list[Outlet]:
        """Every connection that the hook may send on."""
        return list(self._outlets)

    def is_ready(self) -> bool:
        """Whether it may start now: input, output and timer condition, and the node's phase."""
        if not (self.is_enabled and self.is_due) or self.missing_slot() is not None:
            return False
        return not self.blocked or self.can_send()

    def can_send(self) -> bool:
        """Whether none of its outlets is blocked, but for packets that its own start would take."""
        if not self.blocked:
            return True
        return bool(self.loops) and len(self._freed_outlets()) == self.blocked

    def awaited_slot(self) -> InputSlot | None:
        """The first of its required inputs that has no packet, if that is all it waits for."""
        return self.missing_slot() if self._lacking and self._is_enabled and self._is_due else None

    def missing_slot(self) -> InputSlot | None:
        """The first of its required inputs that has no packet."""
        for slot in self.slots:  # a loop, since next() over a generator takes thrice as long
            if slot.missing:
                return slot
        return None

    def is_blocked(self) -> bool:
        """Whether it has all inputs, and only its receivers hold it up."""
        return (
            self.is_enabled and self.is_due and self.missing_slot() is None and not self.can_send()
        )

    def blocking_outlets(self) -> list[Outlet]:
        """The outlets that hold it up."""
        freed = self._freed_outlets() if self.loops else ()
        return [outlet for outlet in self._outlets if outlet.is_blocked and outlet not in freed]

    def has_reliable_packet(self) -> bool:
        """Whether a packet that must not be lost waits for it."""
        return any(slot.has_reliable_packet() for slot in self.slots)

    def set_due(self, start_ns: int, now_ns: int) -> None:
        """Set the next due time, ``start + k * period`` after now; passed ones coalesce."""
        ticks_passed = (now_ns - start_ns) // self.period_ns
        if self.due_ns:
            self.missed_ticks += ticks_passed - (self.due_ns - start_ns) // self.period_ns
        self.due_ns = start_ns + (ticks_passed + 1) * self.period_ns
        self.is_due = False

    def postpone(self, duration_ns: int) -> None:
        """For a tick: a time has passed that does not count."""
        self.due_ns += duration_ns
        if self.ticks is not None:
            self.ticks.skip(duration_ns)

    def packets_of(self, result: Any) -> Sequence[tuple[Output, Any]]:
        """What the hook returned: the packets as they are sent, each with its output.

        Raises:
            HookError: if the count, a type, a missing packet, or a value in one is not as declared.
        """
        results = self._results
        if len(results) == 1 and result is not None and not isinstance(result, _SEVERAL):
            output = results[0][0]  # one packet, as most hooks return: the rest takes a microsecond
            return ((output, self._checked(output, result)),)
        if not results:
            if result is not None:
                raise self.error(f"returned {_kind(result)}, but declares no outputs")
            return ()
        if result is None:
            packets: Sequence[Any] = (None,) * len(results)
        elif isinstance(result, _SEVERAL):
            packets = result
        else:
            packets = (result,)
        if len(packets) != len(results):
            names = ", ".join(output.port.name for output in self.outputs)
            raise self.error(
                f"returned {_count(len(packets), 'packet')}, but declares"
                f" {_count(len(results), 'output')} ({names})"
            )
        found = []
        for (output, is_optional), packet in zip(results, packets, strict=True):
            if packet is None:
                if not is_optional:
                    raise self.error(
                        f"returned no packet for output '{output.port.name}': return one, or"
                        f' declare it as Optional("{output.port.name}")'
                    )
            else:
                found.append((output, self._checked(output, packet)))
        return found

    def error(self, text: str) -> HookError:
        """A ``HookError`` with the address of this hook."""
        return HookError(text, hook=self.name, where=self.spec.where)

    def _checked(self, output: Output, packet: Any) -> Any:
        wanted = output.packet_type
        if wanted is None:
            return packet
        name = output.port.name
        if not isinstance(packet, wanted.kind):
            raise self.error(
                f"returned {_kind(packet)} for output '{name}', which carries"
                f' {output.port.type}: use node.make_packet("{name}")'
            )
        try:
            return wanted.check(packet)
        except WrongValue as error:
            raise self.error(f"packet for output '{name}': {error}") from None

    def _note(self) -> None:
        if self._is_enabled and self._is_due and not self._lacking:
            self.candidates.add(self)
        else:
            self.candidates.discard(self)

    def _loops(self) -> list[tuple[Outlet, InputSlot, Mailbox]]:
        """Connections from this hook to itself."""
        return [
            (outlet, slot, mailbox)
            for outlet in self._outlets
            for slot in self.slots
            for mailbox in slot.mailboxes
            if mailbox.inlet.key is outlet.connection
        ]

    def _freed_outlets(self) -> list[Outlet]:
        """The blocked ones of its outlets whose packets its own start would acknowledge."""
        return [
            outlet
            for outlet, slot, mailbox in self.loops
            if outlet.is_blocked
            and slot.would_take(mailbox)
            and outlet.frees(mailbox.inlet.position_if_taken(mailbox))
        ]


class Source(Hook):
    """Packets from outside the hooks (a simulator's own thread), sent as if a hook returned them.

    It is due while it holds an offer; several wait in line. ``where`` is the plugin's file.
    """

    __slots__ = ("_accepted", "_offers", "_where")

    def __init__(self, names: Sequence[str], outputs: Mapping[str, Output], where: str) -> None:
        spec = HookSpec(HookKind.FUNCTION, _offer, (), tuple(OutputSpec(name) for name in names))
        super().__init__(spec, (), outputs)
        self.name = f"submit({', '.join(names)})"
        self._where = where
        self._offers: dict[object, tuple[Sequence[Any], Callable[[], None]]] = {}
        self._accepted: Callable[[], None] = _nobody
        self.is_due = False

    def offer(self, packets: Sequence[Any], accepted: Callable[[], None]) -> Callable[[], None]:
        """Hold packets, one per output, until the engine takes them; returns how to withdraw."""
        ticket = object()
        self._offers[ticket] = (packets, accepted)
        self.is_due = True

        def withdraw() -> None:
            self._offers.pop(ticket, None)
            self.is_due = bool(self._offers)

        return withdraw

    def take(self) -> Sequence[Any]:
        """Give away the oldest offer."""
        packets, self._accepted = self._offers.pop(next(iter(self._offers)))
        self.is_due = bool(self._offers)
        return packets

    def accept(self) -> None:
        """Tell who made the offer taken last that it has been sent."""
        accepted, self._accepted = self._accepted, _nobody
        accepted()

    def error(self, text: str) -> HookError:
        """A ``HookError``; an offer comes from no line of the plugin, but from its file."""
        return HookError(text, hook=self.name, where=self._where)


def _offer() -> None:
    """Stands for the function of a :class:`Source`."""


def _nobody() -> None:
    """Nobody to tell."""


def _kind(value: object) -> str:
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
