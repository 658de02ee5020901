"""One hook of a running node: its readiness, its counters and the check of its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from neuros.engine.input_queue import HookInput, InputQueue
from neuros.engine.metrics import TickIntervals
from neuros.engine.node_ports import Output
from neuros.engine.send_window import SendWindow
from neuros.errors import HookError, WrongValue
from neuros.hooks import HookKind, HookSpec, OutputSpec

_SEVERAL = (tuple, list)  # as a union it would be made anew at each use


class Hook:
    """A hook and its state; readiness is kept up to date by counting, not by looking.

    Attributes:
        blocked: number of its send windows that are blocked now.
        is_due: False only for a tick between two due times, and for a source with nothing to send.
        is_enabled: whether the phase of the node's lifecycle lets it run at all.
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
        "_results",
        "_windows",
        "blocked",
        "busy_ns",
        "candidates",
        "due_ns",
        "executions",
        "inputs",
        "loops",
        "missed_ticks",
        "name",
        "outputs",
        "period_ns",
        "spec",
        "ticks",
        "turn",
    )

    def __init__(
        self, spec: HookSpec, inputs: Sequence[HookInput], outputs: Mapping[str, Output]
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.inputs = tuple(inputs)
        self.outputs = tuple(outputs[port.name] for port in spec.outputs)
        self._windows = tuple(window for output in self.outputs for window in output.windows)
        self._results = tuple((outputs[port.name], port.is_optional) for port in spec.outputs)
        self.blocked = 0
        self.turn = 0
        self.candidates: set[Hook] = set()
        self._is_due = spec.period_s is None
        self._is_enabled = False
        self._lacking = sum(hook_input.missing > 0 for hook_input in self.inputs)
        for hook_input in self.inputs:
            hook_input.hook = self
        self.executions = 0
        self.busy_ns = 0
        self.due_ns = 0
        self.missed_ticks = 0
        self.period_ns = 0 if spec.period_s is None else max(1, round(spec.period_s * 1e9))
        self.ticks = TickIntervals(self.period_ns) if self.period_ns else None
        self.loops = tuple(self._loops())
        for window in self._windows:
            window.hooks.append(self)
            self.blocked += window.is_blocked

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
        """Whether the phase of the node lets it run."""
        return self._is_enabled

    @is_enabled.setter
    def is_enabled(self, is_enabled: bool) -> None:
        self._is_enabled = is_enabled
        self._note()

    def on_input_complete(self) -> None:
        """One of its inputs has now what it needs."""
        self._lacking -= 1
        if not self._lacking and self._is_enabled and self._is_due:
            self.candidates.add(self)

    def on_input_incomplete(self) -> None:
        """One of its inputs lacks something now."""
        self._lacking += 1
        self.candidates.discard(self)

    def windows(self) -> list[SendWindow]:
        """Every connection that the hook may send on."""
        return list(self._windows)

    def is_ready(self) -> bool:
        """Whether it may start now: input, output and timer condition, and the node's phase."""
        if not (self.is_enabled and self.is_due) or self.missing_input() is not None:
            return False
        return not self.blocked or self.can_send()

    def can_send(self) -> bool:
        """Whether no send window is blocked, but for packets that its own start would take."""
        if not self.blocked:
            return True
        return bool(self.loops) and len(self._freed_windows()) == self.blocked

    def awaited_input(self) -> HookInput | None:
        """The first of its required inputs that has no packet, if that is all it waits for."""
        return self.missing_input() if self._lacking and self._is_enabled and self._is_due else None

    def missing_input(self) -> HookInput | None:
        """The first of its required inputs that has no packet."""
        for hook_input in self.inputs:  # a loop, since next() over a generator takes thrice as long
            if hook_input.missing:
                return hook_input
        return None

    def blocking_windows(self) -> list[SendWindow]:
        """The send windows that hold it up."""
        freed = self._freed_windows() if self.loops else ()
        return [window for window in self._windows if window.is_blocked and window not in freed]

    def has_reliable_packet(self) -> bool:
        """Whether a packet that must not be lost waits for it."""
        return any(hook_input.has_reliable_packet() for hook_input in self.inputs)

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
        """The packets that a hook returned, as they are sent, each with its output.

        Raises:
            HookError: if the count, a type, a missing packet, or a value in one is not as declared.
        """
        results = self._results
        if len(results) == 1 and result is not None and not isinstance(result, _SEVERAL):
            packets: Sequence[Any] = (result,)  # as most hooks return
        elif not results:
            if result is not None:
                raise self.error(f"returned {_kind(result)}, but declares no outputs")
            return ()
        elif result is None:
            packets = (None,) * len(results)
        else:
            packets = result if isinstance(result, _SEVERAL) else (result,)
        if len(packets) != len(results):
            names = ", ".join(output.port.name for output in self.outputs)
            raise self.error(
                f"returned {_count(len(packets), 'packet')}, but declares"
                f" {_count(len(results), 'output')} ({names})"
            )
        found = []
        for (output, is_optional), packet in zip(results, packets):  # noqa: B905, it costs time
            if packet is None:
                if not is_optional:
                    raise self.error(
                        f"returned no packet for output '{output.port.name}': return one, or"
                        f' declare it as Optional("{output.port.name}")'
                    )
                continue
            wanted = output.packet_type
            if wanted is None:
                found.append((output, packet))
                continue
            if not isinstance(packet, wanted.kind):
                raise self.error(
                    f"returned {_kind(packet)} for output '{output.port.name}', which carries"
                    f' {output.port.type}: use node.make_packet("{output.port.name}")'
                )
            try:
                found.append((output, wanted.check(packet)))
            except WrongValue as error:
                text = f"packet for output '{output.port.name}': {error}"
                raise self.error(text) from None
        return found

    def error(self, text: str) -> HookError:
        """A ``HookError`` with the address of this hook."""
        return HookError(text, hook=self.name, where=self.spec.where)

    def _note(self) -> None:
        if self._is_enabled and self._is_due and not self._lacking:
            self.candidates.add(self)
        else:
            self.candidates.discard(self)

    def _loops(self) -> list[tuple[SendWindow, HookInput, InputQueue]]:
        """Connections from this hook to itself."""
        return [
            (window, hook_input, queue)
            for window in self._windows
            for hook_input in self.inputs
            for queue in hook_input.queues
            if queue.subscription.key is window.connection
        ]

    def _freed_windows(self) -> list[SendWindow]:
        """The blocked ones of its send windows whose packets its own start would acknowledge."""
        return [
            window
            for window, hook_input, queue in self.loops
            if window.is_blocked
            and hook_input.would_take(queue)
            and window.frees(queue.subscription.position_if_taken(queue))
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
        self._accepted: Callable[[], None] = _nothing
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
        """Report that the offer taken last has been sent."""
        accepted, self._accepted = self._accepted, _nothing
        accepted()

    def error(self, text: str) -> HookError:
        """A ``HookError``; an offer comes from no line of the plugin, but from its file."""
        return HookError(text, hook=self.name, where=self._where)


def _offer() -> None:
    """Stands for the function of a :class:`Source`."""


def _nothing() -> None:
    """The callback of no offer."""


def _kind(value: object) -> str:
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
