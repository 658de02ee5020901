"""The engine: one node's hooks, run by events.

Each event (a packet, an acknowledgement, a registration, a due timer, the loop-back) is a call of a
method of :class:`Engine`. It changes some counters and is followed by one *pass*: the engine checks
each hook once, least recently executed first, and runs it if it is ready at its turn. If a hook is
still ready afterwards, the engine posts a loop-back, an event that comes after all waiting events.
Arrivals come before hooks: if something may have reached the node while a hook ran, the pass ends,
and the loop-back continues it after the arrivals. So no hook starts on a backlog.
The engine acts on the world through :class:`Effects` only.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from neuros.engine.connection_ends import SendWindow, Subscription
from neuros.engine.hook import Hook, Source
from neuros.engine.metrics import IDLE, PAUSED, REGISTERING, SCHEDULING, Rest, State
from neuros.engine.node_ports import Links, NodePorts, PacketType
from neuros.engine.schedule import FIRST_TURN, ExecutionLog, Lifecycle, Pause, Schedule
from neuros.engine.sim_clock import ClockSubscription
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec
from neuros.project.model import Connection, Node

_LONG_NS = 1_000_000  # the length of a turn of events in neuros.transport.ros_loop


class Effects(Links, Protocol):
    """The only way out of an engine: its calls are all that the engine does to the world."""

    def has_taken_in(self) -> bool:
        """Whether every arrival has become an event, so that a hook may start.

        After False, a loop-back follows.
        """

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook of the plugin; raises ``HookError``."""

    def give_way(self) -> None:
        """Let the other nodes of the process run before the next hook: this one ran long."""

    def post(self, event: Callable[[], None]) -> None:
        """Handle a delivery to the node itself after all waiting events."""

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Handle the loop-back after all waiting events, also those outside of the process."""

    def note_ready(self) -> None:
        """Report that the node has initialised, and waits for :meth:`Engine.activate`."""

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        """A copy of a packet for a connection of the node to itself; nothing is shared."""


class Engine:
    """Runs the hooks of one node.

    Args:
        node: the node, with its ports.
        connections: all connections that begin or end at the node, in the project's order.
        specs: its hooks, in the order of declaration.
        packet_types: by output name, what hooks must return; other outputs allow any value.
        clock: monotonic wall clock in nanoseconds.

    Attributes:
        all_hooks: in the order of declaration, also those that will not run again.
        is_driving: whether it has hooks that start unasked, and so drive the project.
        executing: the hook that runs now.
        since_ns: start of the running hook, or else the time up to which ``spent_ns`` counts.
        spent_ns: wall time by cause; each hook counts its own executions.
        execution_log: the first executions.
        sim_clock: simulated time, as far as the node knows it.
        pauses: the pause of the node, with its times.
        event_log: its events, where they are recorded (:mod:`neuros.engine.event_log`).

    Raises:
        HookError: if a hook names an unknown port, or requires an input that nothing feeds.
    """

    event_log: array[int] | None = None

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
            if connection in self.subscriptions:  # of the node to itself
                self.subscriptions[connection].acknowledge = self._crediting(window)
        self._arrivals = 0
        self._to_itself = 0  # packets of the node to itself that have not arrived
        self._schedule = Schedule()
        self.all_hooks = [
            Hook(spec, ports.inputs_of(spec), self.outputs) for spec in specs if spec.is_scheduled
        ]
        for hook in self.all_hooks:
            self._schedule.add(hook)
        self._lifecycle = Lifecycle(self._schedule, self.send_windows, clock)
        self._sources: dict[tuple[str, ...], Source] = {}
        self._ticks = [h for h in self.all_hooks if h.spec.kind is HookKind.TICK]
        self.pauses = Pause(self._lifecycle, self._ticks)
        self.is_driving = any(hook.drives for hook in self.all_hooks)
        self._has_posted_loop_back = False
        self._is_passing = False
        self.executing: Hook | None = None
        self.spent_ns: Counter[Rest] = Counter()
        self.execution_log = ExecutionLog()
        self._cause = REGISTERING
        self.created_ns = self.since_ns = clock()

    # ------------------------------------------------------------------ events

    def start(self, *, awaits_others: bool = False) -> None:
        """Initialise as soon as every receiver is there, then run the other hooks.

        Args:
            awaits_others: whether the other hooks also wait for :meth:`activate`.
        """
        self._wake()
        self._lifecycle.start(awaits_others=awaits_others)
        self._pass()

    def activate(self) -> None:
        """Every node of the project is ready: tick and function hooks may start.

        They start with the next event. A hook that started now would delay time 0, from which ticks
        count, of the other nodes in the thread.
        """
        self._wake()
        self._lifecycle.activate()

    def on_packet(self, key: Connection | str, packet: Any) -> None:
        """A packet has arrived on a connection, or on the external topic of the input ``key``."""
        self._wake()
        self._arrivals += 1
        self.subscriptions[key].put(self._arrivals, packet)
        if not self.pauses.is_still:
            self._pass()

    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None:
        """All hooks at the far end have started on the packets up to ``position``.

        ``arrival_ns``: when this has arrived; by default now.
        """
        now_ns = self._wake()
        now_ns = now_ns if arrival_ns is None else arrival_ns
        self.send_windows[connection].credit(position, now_ns)
        if not self.execution_log.is_full:
            self.execution_log.record_credit(connection, position, now_ns)
        if self._schedule.candidates and not self.pauses.is_still:  # else no pass finds more
            self._pass()

    def on_registered(self, connection: Connection) -> None:
        self._wake()
        self._lifecycle.register(connection)
        self._pass()

    def on_timer(self) -> None:
        """The time of :attr:`next_due_ns` has come."""
        self._wake()
        self._pass()

    def on_loop_back(self) -> None:
        """The event that the engine posted to itself has come."""
        self._wake()
        self._has_posted_loop_back = False
        self._pass()

    def offer(self, packets: Mapping[str, Any], accepted: Callable[[], None]) -> Callable[[], None]:
        """Send packets, by output, as soon as a hook that returns them could run.

        Offers for the same outputs are accepted in their order. ``accepted`` is called when the
        packets are sent. Returns a function that withdraws the offer until then.

        Raises:
            HookError: if the node has no such output, or a packet is of another type.
        """
        self._wake()
        names = tuple(sorted(packets))
        source = self._sources.get(names)
        if source is None:
            for name in names:
                if name not in self.outputs:
                    text = "{} ({})".format(*self.node.undeclared("output", name))
                    raise HookError(text, hook="submit", where=str(self.node.plugin))
            source = self._sources[names] = Source(names, self.outputs, str(self.node.plugin))
            self._lifecycle.add_source(source)
            self.all_hooks.append(source)
            self.is_driving = True
        withdraw = source.offer([packets[name] for name in names], accepted)
        self._pass()
        return withdraw

    def drain(self, last_round: Sequence[int] = ()) -> None:
        """Stop the hooks that send unasked; the others go on.

        Args:
            last_round: places in :attr:`all_hooks` of the hooks of endless loops: each starts at
                most once more.
        """
        self._wake()
        self._lifecycle.drain(self.all_hooks[place] for place in last_round)
        self._cause = self.rest()
        if self.pauses.is_on:
            self.pauses.end(self._wake())
            self._pass()

    def pause(self) -> None:
        """Start only initialise hooks and steps until :meth:`resume`.

        A second pause revokes the steps that are left. A pause of a draining node has no effect.
        """
        if self._cause is PAUSED:
            self.pauses.revoke()
            return
        now_ns = self._wake()
        if not self._lifecycle.is_draining:
            self.pauses.begin(now_ns)
        self._cause = self.rest()

    def resume(self) -> None:
        """Go on after a pause.

        Hooks start with the next event: one that started now would hold the pause of the other
        nodes in the thread.
        """
        if self.pauses.is_on:
            self.pauses.end(self._wake())
            self._cause = self.rest()
            if self._cause is SCHEDULING and not self._has_posted_loop_back:
                self._has_posted_loop_back = True
                self._effects.post_loop_back(self.on_loop_back)

    def step(self, count: int, *, is_driven: bool) -> None:
        """While paused, let each hook that starts unasked do so ``count`` times more.

        The other hooks answer the packets that they receive; if no hook starts unasked in the whole
        project (``is_driven`` is false), each hook starts ``count`` times. See
        :class:`~neuros.engine.schedule.Pause`.
        """
        self._wake()
        self.pauses.grant(count, self._arrivals, is_driven=is_driven)
        self._pass()

    def reading(self, value: int) -> int:
        """What a hook reads of something that goes on by itself, such as a clock."""
        return value

    def note_callback(self) -> None:
        """A callback of a ROS entity that the plugin has made runs."""

    def stop_hooks(self) -> None:
        """Start no further hook; the packets of the running one are still sent. Any thread."""
        self._lifecycle.is_stopped = True

    # ------------------------------------------------------------------ questions

    @property
    def is_started(self) -> bool:
        return self._lifecycle.is_started

    @property
    def is_active(self) -> bool:
        """Whether every receiver is there, and every node that it waits for is ready."""
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
        """Whether hooks start in steps only."""
        return self.pauses.is_on

    @property
    def tick_start_ns(self) -> int:
        """The end of initialisation, from which ticks are counted; pauses move it on."""
        return self._lifecycle.tick_start_ns

    @property
    def next_due_ns(self) -> int | None:
        """The time of the next :meth:`on_timer`, on the clock of the engine; ``None``: never."""
        if self.pauses.is_on:
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
        """Whether a hook is ready, or could become so without a packet on a connection.

        A missing receiver or node, a timer, or an external topic may make it ready. Threads that
        offer packets are left out: only the runtime knows them.
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
        """The node's main loops: function hooks without required inputs."""
        return self._schedule.free_running_hooks()

    def awaited(self) -> Sequence[Connection]:
        """Connections whose acknowledgements could change which hooks start in the next pass."""
        return [c for c, window in self.send_windows.items() if window.is_tight]

    def untaken_subscriptions(self) -> Sequence[Subscription]:
        """Connections to inputs that no hook declares, without the clock, which the node reads."""
        found = (s for s in self.subscriptions.values() if not s.queues)
        return [s for s in found if not isinstance(s, ClockSubscription)]

    def rest(self) -> Rest:
        """The state of the node now, and its cause. Any thread."""
        executing = self.executing  # read once: the engine may change it meanwhile
        if executing is not None:
            return Rest(State.EXECUTING, executing.name)
        lifecycle = self._lifecycle
        if not lifecycle.has_begun or (not lifecycle.is_active and lifecycle.awaits_others):
            return REGISTERING
        if self.pauses.is_on:
            return PAUSED
        cause = self._schedule.rest()
        return IDLE if self.is_stopped and cause is SCHEDULING else cause

    # ------------------------------------------------------------------ inside

    def _wake(self) -> int:
        """Count the time since the last event, and mark the due ticks; returns the time."""
        now_ns = self._clock()
        if self._ticks and not self.pauses.is_on:
            for hook in self._ticks:
                if hook.is_enabled and not hook.is_due and hook.due_ns <= now_ns:
                    hook.is_due = True
        if self.executing is None:  # else the time is the hook's, which counts it at its end
            self.spent_ns[self._cause] += now_ns - self.since_ns
            self.since_ns = now_ns
        return now_ns

    def _pass(self) -> None:
        """Run each candidate that is ready at its turn, by the turns at the begin of the pass.

        Hooks that run meanwhile add and remove candidates. A new candidate belongs to the pass if
        its turn is still to come, and was given before the pass began: up to ``last`` to executed
        hooks, below ``new`` to the others.
        """
        if self._is_passing:  # hooks never nest, even if one spins: the loop-back continues
            return
        lifecycle, pause, candidates = self._lifecycle, self.pauses, self._schedule.candidates
        if not lifecycle.has_begun:
            return
        if pause.is_on and self._ticks:
            pause.wake_ticks()
        if candidates:
            self._is_passing = True
            place, last, new = FIRST_TURN - 1, self._schedule.last_turn, self._schedule.new_turn
            try:
                while candidates:
                    hook: Hook | None = None
                    for each in candidates:
                        turn = each.turn
                        is_in_pass = place < turn <= last and (turn > 0 or turn < new)
                        if is_in_pass and (hook is None or turn < hook.turn):
                            hook = each
                    if hook is None or lifecycle.is_stopped:
                        break
                    place = hook.turn
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
            self._cause = pause.cause_of_rest(candidates, self.since_ns)
        else:
            self._cause = self._schedule.cause_of_rest()
        if not lifecycle.is_active and self._cause is not SCHEDULING and not self._to_itself:
            # No initialise hook could start: each has run, or needs a packet of another node.
            if not lifecycle.is_ready:
                lifecycle.is_ready = True
                self._effects.note_ready()
            if lifecycle.awaits_others:
                self._cause = REGISTERING
        if self._cause is SCHEDULING and not (self._has_posted_loop_back or lifecycle.is_stopped):
            self._has_posted_loop_back = True
            self._effects.post_loop_back(self.on_loop_back)

    def _run(self, hook: Hook) -> None:
        """Run a hook: move it to the end of the order, consume its inputs, send its packets."""
        self._schedule.move_to_end(hook)
        start_ns = self._clock()
        if self.pauses.is_on:
            self.pauses.record_start(hook, start_ns, self._arrivals)
        elif hook.ticks is not None:
            hook.ticks.record(start_ns)
            hook.set_due(self._lifecycle.tick_start_ns, start_ns)
        if self._lifecycle.last_round and hook in self._lifecycle.last_round:
            self._lifecycle.finish_round(hook)
        self.spent_ns[SCHEDULING] += start_ns - self.since_ns
        self.since_ns = start_ns
        self.executing = hook
        try:
            if isinstance(hook, Source):
                result: Any = hook.consume()
            else:
                arguments = []
                for consume in hook.consumers:
                    arguments.append(consume(start_ns))
                result = self._effects.call(hook, arguments)
        finally:
            self.executing = None
            end_ns = self._clock()
            hook.executions += 1
            hook.busy_ns += end_ns - start_ns
            self.since_ns = end_ns
            if not self.execution_log.is_full:
                self.execution_log.record_execution(hook, start_ns, end_ns)
        if end_ns - start_ns > _LONG_NS:
            self._effects.give_way()
        for output, packet in hook.packets_of(result):
            for window in output.windows:
                window.spend(end_ns)
            for connection in output.to_itself:
                self._send_to_itself(connection, packet)
            if output.send is not None:
                output.send(packet)
        if isinstance(hook, Source):
            hook.accept()
        elif hook.spec.kind is HookKind.INITIALISE:
            for hook_input in hook.inputs:
                for queue in hook_input.queues:
                    queue.subscription.remove(queue)
            self._lifecycle.finish_initialiser(hook)
            if self.pauses.is_on:
                self.pauses.wake_ticks()

    def _send_to_itself(self, connection: Connection, packet: Any) -> None:
        own = self._effects.copy_to_itself(connection, packet)

        def arrive() -> None:
            self._to_itself -= 1
            self.on_packet(connection, own)

        self._to_itself += 1
        self._effects.post(arrive)

    def _crediting(self, window: SendWindow) -> Callable[[int], None]:
        return lambda position: window.credit(position, self._clock())
