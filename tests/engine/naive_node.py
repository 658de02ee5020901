"""A second, naive engine, written straight from the specification and as slow as it likes.

It shares no code with :mod:`neuros.engine`: it keeps every packet in lists and works out readiness
from nothing at each turn. The tests compare what the two do with the same events.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

from neuros.hooks import HookKind, HookSpec, InputSpec, OutputSpec
from neuros.project.model import Connection

Produce = Callable[[HookSpec, int], list[Any]]
"""``produce(spec, count)``: what a hook returns at its count-th execution, one per output."""

CLOCK = "clock"
"""The input that brings simulated time; its packets are ``Clock`` messages."""


class NaiveHook:
    def __init__(self, spec: HookSpec, place: int, sources: dict[str, list[Connection]]) -> None:
        self.spec = spec
        self.inputs = list(spec.inputs)
        if spec.sim_period_s is not None and CLOCK not in [port.name for port in spec.inputs]:
            self.inputs.append(InputSpec(CLOCK))
        self.place = place
        self.last_turn = 0
        self.executions = 0
        self.last_run_ns = 0
        self.starts_in_steps = 0
        self.offers: list[tuple[Any, list[Any]]] | None = None
        self.has_ended = False
        self.is_in_last_round = False
        self.queue: dict[Connection, list[tuple[int, int, Any]]] = {
            c: [] for port in self.inputs for c in sources.get(port.name, [])
        }
        self.looked_at: Any = None
        self.time: Fraction | None = None
        self.periods = 0
        self.position = dict.fromkeys(self.queue, 0)
        self.lost: dict[Connection, set[int]] = {c: set() for c in self.queue}
        self.started: dict[Connection, set[int]] = {c: set() for c in self.queue}


class NaiveNode:
    def __init__(
        self,
        name: str,
        connections: Sequence[Connection],
        specs: Sequence[HookSpec],
        produce: Produce,
        now_ns: Callable[[], int],
    ) -> None:
        self.name = name
        self.produce = produce
        self.now_ns = now_ns
        self.incoming = [c for c in connections if c.destination_node == name]
        self.outgoing = [c for c in connections if c.source_node == name]
        self.sources: dict[str, list[Connection]] = {}
        for c in self.incoming:
            self.sources.setdefault(c.destination_input, []).append(c)
        self.hooks = [NaiveHook(spec, i, self.sources) for i, spec in enumerate(specs)]
        self.all_hooks = list(self.hooks)
        self.registered = {c for c in self.outgoing if c.destination_node == name}
        self.sent = dict.fromkeys(self.outgoing, 0)
        self.acknowledged_by_receiver = dict.fromkeys(self.outgoing, 0)
        self.arrived = dict.fromkeys(self.incoming, 0)
        self.acknowledged = dict.fromkeys(self.incoming, 0)
        self.arrivals = 0
        self.turn = 0
        self.start_ns: int | None = None
        self.events: deque[tuple[Any, ...]] = deque()
        self.log: list[tuple[Any, ...]] = []
        self.sim_time: Fraction | None = None
        self.paused_ns: int | None = None
        self.time_lost_ns = 0
        self.steps, self.is_driven = 0, True
        self.arrivals_by_step = 0
        self.is_draining = False

    # ---- events

    def start(self) -> None:
        self.one_pass()

    def on_registered(self, c: Connection) -> None:
        self.registered.add(c)
        self.one_pass()

    def on_acknowledgement(self, c: Connection, position: int) -> None:
        self.acknowledged_by_receiver[c] = max(self.acknowledged_by_receiver[c], position)
        self.one_pass()

    def on_timer(self) -> None:
        self.one_pass()

    def on_packet(self, c: Connection, packet: Any) -> None:
        self.arrivals += 1
        self.arrived[c] += 1
        for hook in self.hooks:
            if c in hook.queue:
                queue = hook.queue[c]
                if len(queue) == c.queue_size:  # full: the oldest unread one is discarded
                    assert c.discard_limit != 0
                    hook.lost[c].add(queue.pop(0)[1])
                queue.append((self.arrivals, self.arrived[c], packet))
                self.pass_over(hook)
        if not self.takers(c):
            self.acknowledge(c, self.arrived[c])
            if c.destination_input == CLOCK:
                self.sim_time = time_of(packet)
        self.one_pass()

    def offer(self, packets: dict[str, Any], number: int) -> None:
        names = tuple(sorted(packets))
        source = next(
            (h for h in self.hooks if h.offers is not None and _outputs(h) == names), None
        )
        if source is None:
            outputs = tuple(OutputSpec(name) for name in names)
            spec = HookSpec(HookKind.FUNCTION, lambda: None, (), outputs)
            source = NaiveHook(spec, len(self.all_hooks), {})
            source.offers, source.has_ended = [], self.is_draining
            self.hooks.append(source)
            self.all_hooks.append(source)
        assert source.offers is not None
        source.offers.append((number, [packets[name] for name in names]))
        self.one_pass()

    def drain(self, last_round: Sequence[int]) -> None:
        self.is_draining = True
        for hook in self.all_hooks:
            hook.is_in_last_round |= hook.place in last_round
            is_main_loop = hook.spec.outputs and all(port.is_optional for port in hook.inputs)
            hook.has_ended |= bool(is_main_loop) or hook.spec.period_s is not None
        if self.paused_ns is not None:
            self.end_pause()
            self.one_pass()

    def pause(self) -> None:
        if self.is_draining:
            return
        if self.paused_ns is None:
            self.paused_ns = self.now_ns()
        self.steps = 0
        for hook in self.hooks:
            hook.starts_in_steps = 0

    def resume(self) -> None:
        if self.paused_ns is not None:
            self.end_pause()
            self.loop_back_if_startable()

    def end_pause(self) -> None:
        assert self.paused_ns is not None
        self.time_lost_ns += self.now_ns() - self.paused_ns
        self.paused_ns = None

    def step(self, count: int, *, is_driven: bool) -> None:
        if self.paused_ns is not None:
            self.steps += count
            self.is_driven = is_driven
            self.arrivals_by_step = self.arrivals
        self.one_pass()

    def posted_event(self) -> None:
        kind, *rest = self.events.popleft()
        if kind == "own packet":
            self.on_packet(*rest)
        else:
            self.one_pass()

    # ---- rules

    def pass_over(self, hook: NaiveHook) -> None:
        """The tick takes the oldest packet of its clock, uncalled, until it is due by one."""
        if hook.spec.sim_period_s is None:
            return
        period_s = Fraction(repr(hook.spec.sim_period_s))
        (c,) = self.sources[CLOCK]
        while hook.queue[c]:
            _, _, packet = hook.queue[c][0]
            if packet is not hook.looked_at:
                time = time_of(packet)
                if hook.time is None or time < hook.time:
                    before = time - Fraction(1, 10**9)
                    hook.periods = max(0, before // period_s)
                hook.looked_at, hook.time = packet, time
            if time_of(packet) // period_s > hook.periods:
                return
            self.take(hook, c)
            self.acknowledge_taken(c)

    def take(self, hook: NaiveHook, c: Connection) -> Any:
        _, hook.position[c], packet = hook.queue[c].pop(0)
        hook.started[c].add(hook.position[c])
        if c.destination_input == CLOCK:
            self.sim_time = time_of(packet)
        return packet

    def acknowledge_taken(self, c: Connection) -> None:
        self.acknowledge(c, min(h.position[c] for h in self.takers(c)))

    def one_pass(self) -> None:
        for hook in sorted(self.hooks, key=lambda each: (each.last_turn, each.place)):
            if self.is_allowed(hook) and self.is_ready(hook):
                if any(event[0] == "own packet" for event in self.events):
                    break
                self.run(hook)
        self.loop_back_if_startable()

    def loop_back_if_startable(self) -> None:
        is_loop_back_waiting = any(event[0] == "loop-back" for event in self.events)
        startable = [h for h in self.hooks if self.is_allowed(h) and self.is_ready(h)]
        if startable and not is_loop_back_waiting:
            self.events.append(("loop-back",))

    def is_allowed(self, hook: NaiveHook) -> bool:
        """By a pause, and its steps."""
        if self.paused_ns is None or hook.spec.kind is HookKind.INITIALISE:
            return True
        if self.drives(hook) or not self.is_driven:
            return hook.starts_in_steps < self.steps
        return self.steps > 0 and all(
            port.is_optional or queue[0][0] <= self.arrivals_by_step
            for port in hook.inputs
            for c in self.sources.get(port.name, [])
            if (queue := hook.queue[c]) and not c.source_node  # an external topic
        )

    def drives(self, hook: NaiveHook) -> bool:
        is_tick = hook.spec.period_s is not None
        return is_tick or all(port.is_optional for port in hook.inputs)

    def node_time_ns(self) -> int:
        """Time stands still while the node is paused."""
        now_ns = self.now_ns() if self.paused_ns is None else self.paused_ns
        return now_ns - self.time_lost_ns

    def is_ready(self, hook: NaiveHook) -> bool:
        if self.registered != set(self.outgoing) or hook.has_ended:
            return False
        if hook.offers is not None and not hook.offers:
            return False
        is_initialised = all(h.spec.kind is not HookKind.INITIALISE for h in self.hooks)
        if not is_initialised and hook.spec.kind is not HookKind.INITIALISE:
            return False
        if is_initialised and self.start_ns is None:
            self.start_ns = self.node_time_ns()
            for each in self.hooks:
                each.last_run_ns = self.start_ns
        return (
            all(self.has_input(hook, port) for port in hook.inputs)
            and not any(
                self.is_blocked(hook, c)
                for port in hook.spec.outputs
                for c in self.outgoing
                if c.source_output == port.name
            )
            and self.is_due(hook)
        )

    def has_input(self, hook: NaiveHook, port: InputSpec) -> bool:
        filled = [bool(hook.queue[c]) for c in self.sources.get(port.name, [])]
        return port.is_optional or (all(filled) if port.is_all else any(filled))

    def is_due(self, hook: NaiveHook) -> bool:
        """A due time start + k x period lies between its last run and now."""
        if hook.spec.period_s is None or self.paused_ns is not None:
            return True  # a step starts a tick, due or not
        assert self.start_ns is not None
        period_ns = round(hook.spec.period_s * 1e9)
        ticks = (self.node_time_ns() - self.start_ns) // period_ns
        return ticks > (hook.last_run_ns - self.start_ns) // period_ns

    def would_take(self, hook: NaiveHook) -> list[Connection]:
        taken = []
        for port in hook.inputs:
            filled = [c for c in self.sources.get(port.name, []) if hook.queue[c]]
            if port.is_all:
                taken += filled
            elif filled:  # whose oldest packet has waited longest
                taken.append(min(filled, key=lambda c: hook.queue[c][0][0]))
        return taken

    def is_blocked(self, hook: NaiveHook, c: Connection) -> bool:
        if c.discard_limit is None:
            return False
        acknowledged = self.acknowledged_by_receiver[c]
        if c.destination_node == self.name and c in self.would_take(hook):
            positions = [h.queue[c][0][1] if h is hook else h.position[c] for h in self.takers(c)]
            acknowledged = max(acknowledged, min(positions))
        return self.sent[c] - acknowledged >= c.queue_size + c.discard_limit

    def takers(self, c: Connection) -> list[NaiveHook]:
        return [hook for hook in self.hooks if c in hook.queue]

    def acknowledge(self, c: Connection, position: int) -> None:
        if c.discard_limit is None or position <= self.acknowledged[c]:
            return
        self.acknowledged[c] = position
        if c.source_node == self.name:
            self.acknowledged_by_receiver[c] = position
        else:
            self.log.append(("acknowledge", str(c), position))

    def run(self, hook: NaiveHook) -> None:
        hook.has_ended |= hook.is_in_last_round
        self.turn += 1
        hook.last_turn = self.turn
        if self.paused_ns is None:
            hook.last_run_ns = self.node_time_ns()
        else:
            hook.starts_in_steps += 1
            if hook.spec.kind is not HookKind.INITIALISE and self.drives(hook):
                self.arrivals_by_step = self.arrivals
        taken = {}
        for c in self.would_take(hook):
            taken[c] = self.take(hook, c)
            self.acknowledge_taken(c)
            if hook.spec.sim_period_s is not None and c.destination_input == CLOCK:
                hook.periods = time_of(taken[c]) // Fraction(repr(hook.spec.sim_period_s))
                self.pass_over(hook)
                self.sim_time = time_of(taken[c])
        arguments = []
        for port in hook.inputs:
            sources = self.sources.get(port.name, [])
            if port.is_all:
                arguments.append([taken.get(c) for c in sources])
            else:
                arguments.append(next((taken[c] for c in sources if c in taken), None))
        hook.executions += 1
        if hook.offers is None:
            self.log.append(("run", hook.spec.name, arguments, self.sim_time))
            packets = self.produce(hook.spec, hook.executions)
        else:
            number, packets = hook.offers.pop(0)
        for port, packet in zip(hook.spec.outputs, packets, strict=True):
            if packet is None:
                continue
            for c in self.outgoing:
                if c.source_output == port.name:
                    self.sent[c] += 1
                    if c.destination_node == self.name:
                        self.events.append(("own packet", c, packet))
                    else:
                        self.log.append(("send", str(c), packet))
        if hook.offers is not None:
            self.log.append(("accepted", number))
        if hook.spec.kind is HookKind.INITIALISE:
            self.hooks.remove(hook)
            for c in hook.queue:
                takers = self.takers(c)
                self.acknowledge(c, min((h.position[c] for h in takers), default=self.arrived[c]))


def _outputs(hook: NaiveHook) -> tuple[str, ...]:
    return tuple(port.name for port in hook.spec.outputs)


def time_of(packet: Any) -> Fraction:
    """Seconds of a ``Clock`` message."""
    return packet.clock.sec + Fraction(packet.clock.nanosec, 10**9)
