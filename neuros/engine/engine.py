"""The engine: one node's hooks, run by events.

Every event (a packet, an acknowledgement, a registration, a due timer, the loop-back) is one call
of a method here. It changes some counters and is followed by one *pass*: each hook is looked at
once, least recently executed first, and runs if it is ready at its turn. If one is still ready
afterwards, the engine asks for a loop-back, an event that is handled after all that already wait.
Arrivals come first: where something may have reached the node while a hook ran, the pass ends, and
the loop-back goes on when that has been taken in. So no hook starts on a backlog.
All that leaves the engine goes through :class:`Effects`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from neuros.engine.hook import Hook, Source
from neuros.engine.input_queue import Subscription
from neuros.engine.metrics import IDLE, PAUSED, REGISTERING, SCHEDULING, Rest, State
from neuros.engine.node_ports import Links, NodePorts, Output, PacketType, undeclared
from neuros.engine.schedule import ExecutionLog, Lifecycle, Pause, Schedule, drives
from neuros.engine.send_window import SendWindow
from neuros.engine.sim_clock import ClockSubscription
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec
from neuros.project.model import Connection, Node

_LONG_NS = 1_000_000  # as long as a turn of events: see neuros.transport.ros_loop


class Effects(Links, Protocol):
    """The only way out of an engine: its calls are all that the engine does to the world."""

    def has_taken_in(self) -> bool:
        """Whether all that had reached the node has become an event, so that a hook may start.

        After a False, a loop-back comes.
        """

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook of the plugin; raises ``HookError``."""

    def give_way(self) -> None:
        """A hook has taken long: let the other nodes of the process go on before the next one."""

    def post(self, event: Callable[[], None]) -> None:
        """Have a delivery to the node itself handled after all events that already wait."""

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Have the loop-back handled after all events that already wait, outside ones too."""

    def note_ready(self) -> None:
        """The node has initialised as far as it can alone, and awaits :meth:`Engine.activate`."""

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        """A copy for a connection of the node to itself; it shares nothing with this packet."""


class Engine:
    """Runs the hooks of one node.

    Args:
        node: the node, with its ports.
        connections: all connections that begin or end at it, in the project's order.
        specs: its hooks, in the order of declaration.
        packet_types: per output name, what hooks must return; any value will do for others.
        clock: monotonic wall clock in nanoseconds.

    Attributes:
        all_hooks: in the order of declaration, those that will not run again, too.
        executing: the hook that runs now.
        since_ns: when that started, or else up to when the time is counted.
        spent_ns: wall time by cause; that of executions is counted by each hook.
        execution_log: the first executions.
        sim_clock: simulated time, as far as the node knows it.

    Raises:
        HookError: if a hook names a port that the node has not, or needs an input without source.
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
        self.node = node
        self._effects = effects
        self._has_taken_in = effects.has_taken_in
        self._clock = clock
        ports = NodePorts(node, connections, packet_types or {}, effects, clock)
        self.sim_clock = ports.sim_clock
        self.subscriptions, self.send_windows = ports.subscriptions, ports.send_windows
        self.outputs = ports.outputs
        for connection, window in self.send_windows.items():
            if connection in self.subscriptions:  # the node's to itself
                self.subscriptions[connection].acknowledge = self._crediting(window)
        self._arrivals = 0
        self._to_itself = 0  # packets of the node for itself that are on their way
        self._schedule = Schedule()
        self.all_hooks = [
            Hook(spec, ports.inputs_of(spec), self.outputs) for spec in specs if spec.is_scheduled
        ]
        for hook in self.all_hooks:
            self._schedule.add(hook)
        self._lifecycle = Lifecycle(self._schedule, self.send_windows, clock)
        self._sources: dict[tuple[str, ...], Source] = {}
        self._ticks = [h for h in self.all_hooks if h.spec.kind is HookKind.TICK]
        self._pause = Pause(self._lifecycle, self._ticks, lambda: self._arrivals)
        self._has_posted_loop_back = False
        self._is_passing = False
        self.executing: Hook | None = None
        self.spent_ns: Counter[Rest] = Counter()
        self.execution_log = ExecutionLog()
        self._cause = REGISTERING
        self.created_ns = self.since_ns = clock()

    # ------------------------------------------------------------------ events

    def start(self, *, awaits_others: bool = False) -> None:
        """Begin: initialise as soon as every receiver is there, then run the other hooks.

        Args:
            awaits_others: whether the other hooks wait for :meth:`activate` besides.
        """
        self._wake()
        self._lifecycle.start(awaits_others=awaits_others)
        self._pass()

    def activate(self) -> None:
        """Every node of the project is ready: tick and function hooks may start.

        None starts before the next event. A hook of one node would delay time 0, from which ticks
        count, for the nodes that share its thread.
        """
        self._wake()
        self._lifecycle.activate()

    def on_packet(self, key: Connection | str, packet: Any) -> None:
        """A packet has arrived on a connection, or on the external topic of the input ``key``."""
        self._wake()
        subscription = self.subscriptions[key]
        self._arrivals += 1
        subscription.put(self._arrivals, packet)
        self._pass()

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        """All takers at the far end have started on the packets up to ``position``."""
        now_ns = self._wake()
        self.send_windows[connection].credit(position, now_ns)
        if not self.execution_log.is_full:
            self.execution_log.note_credit(connection, position, now_ns)
        self._pass()

    def on_registered(self, connection: Connection) -> None:
        """The receiver of one of the outputs' connections is there."""
        self._wake()
        self._lifecycle.register(connection)
        self._pass()

    def on_timer(self) -> None:
        """The time of :attr:`next_due_ns` has come."""
        self._wake()
        self._pass()

    def on_loop_back(self) -> None:
        """The event that the engine posted to itself.

        All that waited then has been taken in, but a hook may have run since: it is an event like
        any other.
        """
        self._wake()
        self._has_posted_loop_back = False
        self._pass()

    def offer(self, packets: Mapping[str, Any], accepted: Callable[[], None]) -> Callable[[], None]:
        """Send packets as if a hook with those outputs had returned them, once it might run.

        ``accepted`` is called when they are sent. Returns a function that withdraws the offer; it
        has no effect any more once that is accepted. Offers for the same outputs wait in line.

        Raises:
            HookError: if the node has no such output, or a packet is of another type.
        """
        self._wake()
        names = tuple(sorted(packets))
        source = self._sources.get(names) or self._add_source(names)
        withdraw = source.offer([packets[name] for name in names], accepted)
        self._pass()
        return withdraw

    def drain(self, last_round: Sequence[int] = ()) -> None:
        """Stop the hooks that send unasked; the others go on.

        Args:
            last_round: places in :attr:`all_hooks` of hooks that would go on for ever (each of a
                loop waits for the one before): they start at most once more.
        """
        self._wake()
        self._lifecycle.drain(self.all_hooks[place] for place in last_round)
        self._cause = self.rest()
        self.resume()

    def pause(self) -> None:
        """Start no further hook until :meth:`resume`, but for initialise hooks and steps.

        Where draining has begun it has no effect. A second time it takes back what is left of
        steps.
        """
        now_ns = self._wake()
        if not self._lifecycle.is_draining:
            self._pause.begin(now_ns)
        self._cause = self.rest()

    def resume(self) -> None:
        """Go on after a pause; without one it has no effect."""
        if self._pause.is_on:
            self._pause.end(self._wake())
            self._pass()

    def step(self, count: int, *, is_driven: bool) -> None:
        """While paused, let each hook that starts unasked do so ``count`` times more.

        The others answer what they receive; where nothing drives the project (``is_driven`` is
        false), each hook starts so many times. See :class:`~neuros.engine.schedule.Pause`.
        """
        self._wake()
        self._pause.grant(count, is_driven=is_driven)
        self._pass()

    def stop_hooks(self) -> None:
        """Start no further hook, ever (what the running one returns is still sent). Any thread."""
        self._lifecycle.is_stopped = True

    # ------------------------------------------------------------------ questions

    @property
    def is_started(self) -> bool:
        """Whether :meth:`start` was called."""
        return self._lifecycle.is_started

    @property
    def is_active(self) -> bool:
        """Whether it has begun, and need not wait for other nodes to become ready."""
        return self._lifecycle.has_begun and self._lifecycle.is_active

    @property
    def is_running(self) -> bool:
        """Whether every initialise hook has run."""
        return self._lifecycle.is_running

    @property
    def is_stopped(self) -> bool:
        """Whether no further hook starts."""
        return self._lifecycle.is_stopped

    @property
    def is_paused(self) -> bool:
        """Whether hooks stand still, but for steps."""
        return self._pause.is_on

    @property
    def pauses(self) -> Pause:
        """Its pause, with the times in which it stood still."""
        return self._pause

    @property
    def is_driving(self) -> bool:
        """Whether it has hooks that start unasked, and so keep a project going."""
        return any(map(drives, tuple(self.all_hooks)))

    @property
    def tick_start_ns(self) -> int:
        """The end of initialisation, from which ticks are counted; pauses move it on."""
        return self._lifecycle.tick_start_ns

    @property
    def next_due_ns(self) -> int | None:
        """When :meth:`on_timer` is wanted next, on the clock that was given; ``None``: never."""
        if self._pause.is_on:
            return None
        return min(
            (hook.due_ns for hook in self._ticks if hook.is_enabled and not hook.is_due),
            default=None,
        )

    @property
    def has_ready_hook(self) -> bool:
        """Whether some hook could start now."""
        return not self.is_stopped and self._schedule.has_ready_hook()

    @property
    def has_startable_packet(self) -> bool:
        """Whether some hook could start now on a packet of a reliable connection."""
        return not self.is_stopped and self._schedule.has_startable_packet()

    @property
    def is_wakeable(self) -> bool:
        """Whether a hook is ready, or something other than its connections could make one so.

        That is a receiver or a node that has still to appear, a timer, or an external topic. A
        thread that may offer packets is known to the runtime only.
        """
        if self.is_stopped:
            return False
        lifecycle = self._lifecycle
        is_starting = not (lifecycle.has_begun and lifecycle.is_active)
        return is_starting or self._schedule.is_wakeable()

    def hooks(self) -> Sequence[Hook]:
        """The hooks that may still run, least recently executed first."""
        return tuple(self._schedule.order)

    def free_running_hooks(self) -> Sequence[Hook]:
        """Hooks that nothing but blocked outputs ever holds up: the node's main loops."""
        return self._schedule.free_running_hooks()

    def untaken_subscriptions(self) -> Sequence[Subscription]:
        """Connections to inputs that no hook takes, but for the clock, which the node takes."""
        found = (s for s in self.subscriptions.values() if not s.queues)
        return [s for s in found if not isinstance(s, ClockSubscription)]

    def rest(self) -> Rest:
        """The state of the node now, and its cause."""
        executing = self.executing  # read once: other threads ask, too
        if executing is not None:
            return Rest(State.EXECUTING, executing.name)
        if not self._lifecycle.has_begun or self._lifecycle.awaits_others:
            return REGISTERING
        if self._pause.is_on:
            return PAUSED
        cause = self._schedule.rest()
        return IDLE if self.is_stopped and cause is SCHEDULING else cause

    # ------------------------------------------------------------------ inside

    def _wake(self) -> int:
        """Count the time since the last event, and note the ticks due by now; returns the time."""
        now_ns = self._clock()
        if self._ticks and not self._pause.is_on:
            for hook in self._ticks:
                if hook.is_enabled and not hook.is_due and hook.due_ns <= now_ns:
                    hook.is_due = True
        if self.executing is None:  # else it is the hook's, and counted when that ends
            self.spent_ns[self._cause] += now_ns - self.since_ns
            self.since_ns = now_ns
        return now_ns

    def _pass(self) -> None:
        if self._is_passing:  # a hook that spins, say: hooks never nest, the loop-back sees to it
            return
        lifecycle, pause = self._lifecycle, self._pause
        if not lifecycle.has_begun:
            return
        if pause.is_on:
            pause.wake_ticks()
        if self._schedule.candidates:
            self._is_passing = True
            try:
                for hook in self._schedule.one_pass():
                    if lifecycle.is_stopped:
                        break
                    if pause.is_on and not pause.allows(hook):
                        continue
                    if not hook.blocked or hook.can_send():
                        if self._to_itself or not self._has_taken_in():
                            break
                        self._run(hook)
            finally:
                self._is_passing = False
        if lifecycle.is_stopped:
            self._cause = self.rest()
        elif pause.is_on:
            self._cause = pause.cause_of_rest(self._schedule.candidates, self.since_ns)
        else:
            self._cause = self._schedule.cause_of_rest()
        if not lifecycle.is_active and self._cause is not SCHEDULING and not self._to_itself:
            self._await_others()
        if self._cause is SCHEDULING and not (self._has_posted_loop_back or lifecycle.is_stopped):
            self._has_posted_loop_back = True
            self._effects.post_loop_back(self.on_loop_back)

    def _await_others(self) -> None:
        """No initialise hook could start: each has run, or needs something of another node."""
        if not self._lifecycle.is_ready:
            self._lifecycle.is_ready = True
            self._effects.note_ready()
        if self._lifecycle.awaits_others:
            self._cause = REGISTERING

    def _run(self, hook: Hook) -> None:
        """Start a hook: move it to the end of the order, take its packets, send what it returns."""
        self._schedule.move_to_end(hook)
        start_ns = self._clock()
        if self._pause.is_on:
            self._pause.note_start(hook, start_ns)
        elif hook.ticks is not None:
            hook.ticks.note(start_ns)
            hook.set_due(self._lifecycle.tick_start_ns, start_ns)
        if self._lifecycle.last_round and hook in self._lifecycle.last_round:
            self._lifecycle.finish_round(hook)
        self.spent_ns[SCHEDULING] += start_ns - self.since_ns
        self.since_ns = start_ns
        self.executing = hook
        try:
            if isinstance(hook, Source):
                result: Any = hook.take()
            else:
                arguments = []
                for hook_input in hook.inputs:
                    arguments.append(hook_input.take(start_ns))
                result = self._effects.call(hook, arguments)
        finally:
            self.executing = None
            end_ns = self._clock()
            hook.executions += 1
            hook.busy_ns += end_ns - start_ns
            self.since_ns = end_ns
            if not self.execution_log.is_full:
                self.execution_log.note_execution(hook, start_ns, end_ns)
        if end_ns - start_ns > _LONG_NS:
            self._effects.give_way()
        for output, packet in hook.packets_of(result):
            self._send(output, packet, self.since_ns)
        if isinstance(hook, Source):
            hook.accept()
        elif hook.spec.kind is HookKind.INITIALISE:
            self._retire(hook)
            self._lifecycle.finish_initialiser(hook)
            if self._pause.is_on:
                self._pause.wake_ticks()

    def _retire(self, hook: Hook) -> None:
        """Remove the input queues of a hook that will never run again."""
        for hook_input in hook.inputs:
            for queue in hook_input.queues:
                queue.subscription.remove(queue)

    def _send(self, output: Output, packet: Any, now_ns: int) -> None:
        """Send a packet now on all connections of an output, or on its external topic."""
        for window in output.windows:
            window.spend(now_ns)
        for connection in output.to_itself:
            self._send_to_itself(connection, packet)
        if output.send is not None:
            output.send(packet)

    def _send_to_itself(self, connection: Connection, packet: Any) -> None:
        own = self._effects.copy_to_itself(connection, packet)
        self._to_itself += 1

        def arrive() -> None:
            self._to_itself -= 1
            self.on_packet(connection, own)

        self._effects.post(arrive)

    def _crediting(self, window: SendWindow) -> Callable[[int], None]:
        return lambda position: window.credit(position, self._clock())

    def _add_source(self, names: tuple[str, ...]) -> Source:
        for name in names:
            if name not in self.outputs:
                text = undeclared("output", name, self.outputs, self.node)
                raise HookError(text, hook="submit", where=str(self.node.plugin))
        source = self._sources[names] = Source(names, self.outputs, str(self.node.plugin))
        self._lifecycle.add_source(source)
        self.all_hooks.append(source)
        return source
