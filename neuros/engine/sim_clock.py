"""Simulated time of a node, and its ticks by it: both from the packets of one input, its clock.

Simulated time is that of the clock packet that a hook of the node took last; where no hook takes
the clock, of the last one that has arrived. A tick by simulated time is a function hook that
requires the clock, and starts on a packet of it that reaches the next due time. Earlier packets it
passes over: they are taken as soon as they are the oldest, and no function is called. While the
tick runs, simulated time is that of its own packet, though later ones are passed over as it starts.
So priority, flow control, logging and replay of such a hook are those of any other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import wraps
from typing import Any

from neuros.engine.input_queue import HookInput, InputQueue, Subscription
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec, InputSpec
from neuros.project.model import Node
from neuros.time import to_nanoseconds


class SimClock:
    """Simulated time as far as a node knows it.

    Attributes:
        now_ns: ``None`` before the first packet, and where the node has no clock.
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

    def take(self, queue: InputQueue, now_ns: int) -> Any:
        packet = super().take(queue, now_ns)
        self.sim_clock.now_ns = to_nanoseconds(packet)
        return packet


class Periods:
    """Counts periods of simulated time: due at 1, 2, ... of them, from time zero on.

    The first packet, and one that is earlier than the one before it (the simulation was reset), is
    due only if it is at such a time.
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
        """The tick of this time runs; returns how many before it were missed."""
        missed = self._passed(time_ns) - self._done - 1
        self._done += missed + 1
        return max(0, missed)

    def _passed(self, time_ns: int) -> int:
        # A stamp is a whole number of nanoseconds, rounded: half of one early is on time.
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
        self._pass_over_early_ones(self._clock())

    def on_discarded(self) -> None:
        self._pass_over_early_ones(self._clock())

    def take(self, now_ns: int) -> Any:
        packet = super().take(now_ns)
        time_ns = to_nanoseconds(packet)
        self.hook.missed_ticks += self._periods.tick(time_ns)
        self._pass_over_early_ones(now_ns)
        self._sim_clock.now_ns = time_ns  # not that of packets which it passes over
        return packet

    def _pass_over_early_ones(self, now_ns: int) -> None:
        while (queue := self.chosen()) is not None:
            if self._periods.is_due(to_nanoseconds(queue.packets[0][2])):
                return
            queue.subscription.take(queue, now_ns)


def with_clocks(node: Node, specs: Sequence[HookSpec]) -> list[HookSpec]:
    """The hooks of a node, where ticks by simulated time are functions that take its clock.

    Raises:
        HookError: if there is one, and the node has no clock.
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
