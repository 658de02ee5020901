"""Simulated time of a node, and ticks by simulated time, from the packets of the node's clock.

Simulated time is that of the clock packet that a hook consumed last, or that has arrived last if no
hook declares the clock. A tick by simulated time is a function hook that requires the clock, and
starts on a clock packet that reaches the next due time. Earlier packets are skipped: they are
consumed as soon as they are the oldest, without a call. While the tick runs, simulated time is that
of its own packet, even if its start has skipped later ones. So priority, flow control, logging and
replay of such a hook are those of every function hook.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import wraps
from typing import Any

from neuros.engine.connection_ends import HookInput, InputQueue, Subscription
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec, InputSpec
from neuros.project.model import Node
from neuros.time import to_nanoseconds


class SimClock:
    """The simulated time of a node.

    Attributes:
        now_ns: ``None`` before the first packet, and of a node without a clock.
    """

    __slots__ = ("now_ns",)

    def __init__(self) -> None:
        self.now_ns: int | None = None


class ClockSubscription(Subscription):
    """The connection, or external topic, that brings the clock."""

    __slots__ = ("sim_clock",)

    sim_clock: SimClock

    def put(self, arrival: int, packet: Any) -> None:
        if not self.queues:
            self.sim_clock.now_ns = to_nanoseconds(packet)
        super().put(arrival, packet)

    def consume(self, queue: InputQueue, now_ns: int) -> Any:
        packet = super().consume(queue, now_ns)
        self.sim_clock.now_ns = to_nanoseconds(packet)
        return packet


class Periods:
    """Counts periods of simulated time from time zero on; a tick is due at the end of each.

    The first packet, and the first one after a reset of the simulation (its time is earlier than
    that of the packet before), is due only if it is at the end of a period.
    """

    def __init__(self, period_s: float) -> None:
        self._period_ns = Fraction(repr(period_s)) * 1_000_000_000
        self._seen_ns: int | None = None
        self._done = 0

    def is_due(self, time_ns: int) -> bool:
        """Whether a period has passed since the last tick."""
        if self._seen_ns is None or time_ns < self._seen_ns:
            self._done = max(0, self._passed(time_ns - 1))
        self._seen_ns = time_ns
        return self._passed(time_ns) > self._done

    def tick(self, time_ns: int) -> int:
        """Count a tick that runs at this time; returns the number of missed ticks before it."""
        missed = self._passed(time_ns) - self._done - 1
        self._done += missed + 1
        return max(0, missed)

    def _passed(self, time_ns: int) -> int:
        # Stamps are rounded to nanoseconds: one that is early by half a nanosecond is on time.
        return (time_ns * 2 + 1) * self._period_ns.denominator // (self._period_ns.numerator * 2)


class TickInput(HookInput):
    """The clock as the input of a tick by simulated time."""

    __slots__ = ("_clock", "_periods", "_sim_clock")

    def __init__(
        self,
        spec: InputSpec,
        subscriptions: list[Subscription],
        period_s: float,
        clock: Callable[[], int],
        sim_clock: SimClock,
    ) -> None:
        super().__init__(spec, subscriptions)
        self._periods = Periods(period_s)
        self._clock = clock
        self._sim_clock = sim_clock

    def on_filled(self) -> None:
        super().on_filled()
        self._skip_early(self._clock())

    def on_discarded(self) -> None:
        self._skip_early(self._clock())

    def consumer(self) -> Callable[[int], Any]:
        return self.consume

    def consume(self, now_ns: int) -> Any:
        packet = super().consume(now_ns)
        time_ns = to_nanoseconds(packet)
        self.hook.missed_ticks += self._periods.tick(time_ns)
        self._skip_early(now_ns)
        self._sim_clock.now_ns = time_ns  # not that of skipped packets
        return packet

    def _skip_early(self, now_ns: int) -> None:
        while (queue := self.chosen()) is not None:
            if self._periods.is_due(to_nanoseconds(queue.packets[0][2])):
                return
            queue.subscription.consume(queue, now_ns)


def with_clocks(node: Node, specs: Sequence[HookSpec]) -> list[HookSpec]:
    """The hooks of a node; ticks by simulated time become functions with the clock as an input.

    Raises:
        HookError: if there is such a tick, and the node has no clock, or an unsuitable one.
    """
    return [spec if spec.sim_period_s is None else _with_clock(node, spec) for spec in specs]


def _with_clock(node: Node, spec: HookSpec) -> HookSpec:
    clock = node.clock
    if clock is None:
        raise HookError(": ".join(node.no_clock), hook=spec.name, where=spec.where)
    for port in spec.inputs:
        if port.name == clock.name:
            if port.is_all or port.is_optional:
                raise HookError(
                    f"ticks by the packets of '{clock.name}': take that input without All and"
                    " Optional, or leave it out",
                    hook=spec.name,
                    where=spec.where,
                )
            return replace(spec, kind=HookKind.FUNCTION)
    function = spec.function

    @wraps(function)
    def without_clock(handle: Any, *inputs: Any) -> Any:
        return function(handle, *inputs[:-1])

    inputs = (*spec.inputs, InputSpec(clock.name))
    return replace(spec, kind=HookKind.FUNCTION, function=without_clock, inputs=inputs)
