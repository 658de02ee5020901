"""The engine: one node's hooks, run by events.

Every event (a packet, an acknowledgement, a registration, a due timer, the loop-back) is one call
of a method here. It changes some counters and is followed by one *pass*: each hook is looked at
once, least recently executed first, and runs if it is ready at its turn. If one is still ready
afterwards, the engine asks for a loop-back, an event that is handled after all that already wait.
All that leaves the engine goes through :class:`Effects`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from neuros.core.accounting import (
    IDLE,
    REGISTERING,
    SCHEDULING,
    Accounts,
    Rest,
    State,
    cause_of_rest,
)
from neuros.core.hook import Hook, Output, Source
from neuros.core.inputs import Inlet
from neuros.core.node_ports import NodePorts, undeclared
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec
from neuros.project.model import Connection, Node, Port

_MANY = 2**62
"""More hooks and executions than there will be."""


class Effects(Protocol):
    """What an engine does to the world."""

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook of the plugin; raises ``HookError``."""

    def send(self, connections: Sequence[Connection], packet: Any) -> None:
        """Send on these connections, which lead to other nodes."""

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on an external topic."""

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Tell the sender of a connection from another node."""

    def post(self, event: Callable[[], None]) -> None:
        """Have a delivery to the node itself handled after all events that already wait."""

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Have the loop-back handled after all events that already wait, outside ones too."""

    def copy(self, packet: Any) -> Any:
        """A packet that shares nothing with this one."""


class Engine:
    """Runs the hooks of one node.

    Args:
        node: the node, with its ports.
        connections: all connections that begin or end at it, in the project's order.
        specs: its hooks, in the order of declaration.
        packet_types: message class per output name, for checking what hooks return.
        clock: monotonic wall clock in nanoseconds.

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
        packet_types: Mapping[str, type] | None = None,
    ) -> None:
        self.node = node
        self._effects = effects
        self._clock = clock
        self._arrivals = 0
        ports = NodePorts(node, connections, packet_types or {})
        self.inlets, self.outlets, self.outputs = ports.inlets, ports.outlets, ports.outputs
        self._unregistered = sum(not outlet.is_registered for outlet in self.outlets.values())
        hooks = [ports.hook(spec) for spec in specs if spec.kind is not HookKind.FINALISE]
        self._order: dict[Hook, None] = dict.fromkeys(hooks)
        self._candidates: set[Hook] = set()
        self._turn = 0
        self._first_turn = -_MANY
        for hook in hooks:
            self._line_up(hook)
        self.all_hooks: list[Hook] = hooks
        self._sources: dict[tuple[str, ...], Source] = {}
        self._initialisers = [h for h in hooks if h.spec.kind is HookKind.INITIALISE]
        self._ticks = [h for h in hooks if h.spec.kind is HookKind.TICK]
        self.is_started = False
        self.is_running = False
        self.is_draining = False
        self.is_stopped = False
        self.tick_start_ns = 0
        self._has_posted_loop_back = False
        self._is_passing = False
        self.executing: Hook | None = None
        self.accounts = Accounts()
        self._cause = REGISTERING
        self.created_ns = self.rest_since_ns = clock()

    # ------------------------------------------------------------------ events

    def start(self) -> None:
        """Begin: run hooks from now on, as soon as every receiver is there."""
        self._wake()
        self.is_started = True
        self._begin_if_registered()
        self._pass()

    def on_packet(self, key: Connection | str, packet: Any) -> None:
        """A packet has arrived on a connection, or on the external topic of the input ``key``."""
        self._wake()
        inlet = self.inlets[key]
        self._arrivals += 1
        inlet.put(self._arrivals, packet)
        if not inlet.mailboxes:
            self._acknowledge(inlet)
        self._pass()

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        """All takers at the far end have started on the packets up to ``position``."""
        now_ns = self._wake()
        self.outlets[connection].credit(position, now_ns)
        self._pass()

    def on_registered(self, connection: Connection) -> None:
        """The receiver of one of the outputs' connections is there."""
        self._wake()
        self._register(connection)
        self._pass()

    def on_timer(self) -> None:
        """The time of :attr:`next_due_ns` has come."""
        now_ns = self._wake()
        for hook in self._ticks:
            if hook.is_enabled and not hook.is_due and hook.due_ns <= now_ns:
                hook.is_due = True
        self._pass()

    def on_loop_back(self) -> None:
        """The event that the engine posted to itself."""
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

    # ------------------------------------------------------------------ phases

    def stop_hooks(self) -> None:
        """Start no further hook, ever (what the running one returns is still sent). Any thread."""
        self.is_stopped = True

    def drain(self) -> None:
        """Stop the hooks that send unasked; the others go on."""
        self._wake()
        self.is_draining = True
        for hook in self._order:
            if hook.spec.sends_unasked:
                hook.is_enabled = False
        self._cause = self.rest()

    @property
    def next_due_ns(self) -> int | None:
        """When :meth:`on_timer` is wanted next, on the clock that was given; ``None``: never."""
        return min(
            (hook.due_ns for hook in self._ticks if hook.is_enabled and not hook.is_due),
            default=None,
        )

    @property
    def has_ready_hook(self) -> bool:
        """Whether some hook could start now."""
        return not self.is_stopped and any(hook.is_ready() for hook in self._order)

    @property
    def has_startable_packet(self) -> bool:
        """Whether some hook could start now on a packet of a reliable connection."""
        return not self.is_stopped and any(
            hook.has_reliable_packet() and hook.is_ready() for hook in self._order
        )

    @property
    def is_wakeable(self) -> bool:
        """Whether a hook is ready, or something other than its connections could make one so.

        That is a receiver that has still to appear, a timer, or an external topic. A thread that
        may offer packets is known to the runtime only.
        """
        if self.is_stopped:
            return False
        if not self.is_started or self._unregistered:
            return True
        return any(hook.is_enabled and _could_wake(hook) for hook in self._order)

    @property
    def since_ns(self) -> int:
        """When the running hook started, or else up to when the time is booked."""
        return self.rest_since_ns

    def hooks(self) -> Sequence[Hook]:
        """The hooks that may still run, least recently executed first."""
        return tuple(self._order)

    def free_running_hooks(self) -> Sequence[Hook]:
        """Hooks that nothing but blocked outputs ever holds up: the node's main loops."""
        return [
            hook
            for hook in self._order
            if hook.spec.kind is HookKind.FUNCTION
            and not isinstance(hook, Source)
            and all(slot.is_optional for slot in hook.slots)
        ]

    def untaken_inlets(self) -> Sequence[Inlet]:
        """Connections to inputs that no hook takes."""
        return [inlet for inlet in self.inlets.values() if not inlet.mailboxes]

    def rest(self) -> Rest:
        """What the node does now, and why."""
        executing = self.executing  # read once: other threads ask, too
        if executing is not None:
            return Rest(State.EXECUTING, executing.name)
        if not self.is_started or self._unregistered:
            return REGISTERING
        cause = cause_of_rest(self._order)
        return IDLE if self.is_stopped and cause is SCHEDULING else cause

    # ------------------------------------------------------------------ inside

    def _wake(self) -> int:
        """Book the time since the last event; returns the time now."""
        now_ns = self._clock()
        if self.executing is None:  # else it is the hook's, and booked when that ends
            self.accounts.spend(self._cause, now_ns - self.rest_since_ns)
            self.rest_since_ns = now_ns
        return now_ns

    def _pass(self) -> None:
        if self._is_passing:  # a hook that spins, say: hooks never nest, the loop-back sees to it
            return
        if not self.is_started or self._unregistered:
            return
        if self._candidates:
            self._is_passing = True
            try:
                self._run_candidates()
            finally:
                self._is_passing = False
        self._cause = self.rest() if self.is_stopped else self._cause_of_rest()
        if self._cause is SCHEDULING and not (self._has_posted_loop_back or self.is_stopped):
            self._has_posted_loop_back = True
            self._effects.post_loop_back(self.on_loop_back)

    def _run_candidates(self) -> None:
        """Ask each hook at its turn, in the order of priority that holds now."""
        last, first_new, place = self._turn, self._first_turn, -_MANY - 1
        while self._candidates and not self.is_stopped:
            hook = self._next(place, first_new, last)
            if hook is None:
                return
            place = hook.turn
            if not hook.blocked or hook.can_send():
                self._run(hook)

    def _next(self, place: int, first_new: int, last: int) -> Hook | None:
        """The next candidate in the priority order behind ``place``.

        Its turn is one that was given when the pass began: up to ``last`` to hooks that have been
        executed, below ``first_new`` to the others.
        """
        found: Hook | None = None
        for hook in self._candidates:
            turn = hook.turn
            is_in_pass = place < turn <= last and (turn > 0 or turn < first_new)
            if is_in_pass and (found is None or turn < found.turn):
                found = hook
        return found

    def _cause_of_rest(self) -> Rest:
        """As :func:`cause_of_rest`, without a look at all the hooks that only wait."""
        if not self._candidates:
            for hook in self._order:
                slot = hook.missing_slot()
                if slot is not None and hook.is_enabled and hook.is_due:
                    return slot.rest
            return IDLE
        for hook in self._candidates:
            if not hook.blocked or hook.can_send():
                return SCHEDULING
        first = min(self._candidates, key=_turn)
        return first.blocking_outlets()[0].rest

    def _line_up(self, hook: Hook) -> None:
        """Give a new hook its place: before all that have been executed, behind all others."""
        hook.candidates = self._candidates
        hook.turn = self._first_turn
        self._first_turn += 1

    def _run(self, hook: Hook) -> None:
        """Start a hook: move it to the end of the order, take its packets, send what it returns."""
        del self._order[hook]
        self._order[hook] = None
        self._turn += 1
        hook.turn = self._turn
        start_ns = self._clock()
        if hook.ticks is not None:
            hook.ticks.note(start_ns)
            hook.set_due(self.tick_start_ns, start_ns)
        self.accounts.spend(SCHEDULING, start_ns - self.rest_since_ns)
        self.rest_since_ns = start_ns
        self.executing = hook
        try:
            if isinstance(hook, Source):
                result: Any = hook.take()
            else:
                result = self._effects.call(hook, self._take(hook))
        finally:
            self.executing = None
            end_ns = self._clock()
            hook.executions += 1
            hook.busy_ns += end_ns - start_ns
            self.rest_since_ns = end_ns
        for output, packet in hook.packets_of(result):
            self._send(output, packet)
        if isinstance(hook, Source):
            hook.accept()
        elif hook.spec.kind is HookKind.INITIALISE:
            self._finish_initialiser(hook)

    def _take(self, hook: Hook) -> list[Any]:
        touched: list[Inlet] = []
        arguments = [slot.take(touched) for slot in hook.slots]
        for inlet in touched:
            self._acknowledge(inlet)
        return arguments

    def _acknowledge(self, inlet: Inlet) -> None:
        if not inlet.is_acknowledged:
            return
        position = inlet.position_if_taken()
        if position <= inlet.acknowledged:
            return
        inlet.acknowledged = position
        connection: Any = inlet.key  # external topics are not acknowledged
        if connection.source_node == self.node.name:
            self.outlets[connection].credit(position, self._clock())
        else:
            self._effects.acknowledge(connection, position)

    def _send(self, output: Output, packet: Any) -> None:
        if output.port.external_topic is not None:
            self._effects.send_external(output.port, packet)
            return
        for outlet in output.outlets:
            outlet.spend()
        for connection in output.to_itself:
            self._send_to_itself(connection, packet)
        if output.elsewhere:
            self._effects.send(output.elsewhere, packet)

    def _send_to_itself(self, connection: Connection, packet: Any) -> None:
        own = self._effects.copy(packet)
        self._effects.post(lambda: self.on_packet(connection, own))

    def _register(self, connection: Connection) -> None:
        outlet = self.outlets[connection]
        if not outlet.is_registered:
            outlet.is_registered = True
            self._unregistered -= 1
            self._begin_if_registered()

    def _begin_if_registered(self) -> None:
        if not self.is_started or self._unregistered or self.is_running:
            return
        for hook in self._initialisers:
            hook.is_enabled = self._goes_on(hook)
        if not self._initialisers:
            self._begin_running()

    def _finish_initialiser(self, hook: Hook) -> None:
        self._initialisers.remove(hook)
        hook.is_enabled = False
        del self._order[hook]
        for slot in hook.slots:
            for mailbox in slot.mailboxes:
                mailbox.inlet.remove(mailbox)
                self._acknowledge(mailbox.inlet)
        if not self._initialisers:
            self._begin_running()

    def _begin_running(self) -> None:
        self.is_running = True
        self.tick_start_ns = self._clock()
        for hook in self._order:
            hook.is_enabled = self._goes_on(hook)
            if hook.period_ns:
                hook.set_due(self.tick_start_ns, self.tick_start_ns)

    def _goes_on(self, hook: Hook) -> bool:
        return not (self.is_draining and hook.spec.sends_unasked)

    def _add_source(self, names: tuple[str, ...]) -> Source:
        for name in names:
            if name not in self.outputs:
                text = undeclared("output", name, self.outputs, self.node)
                raise HookError(text, hook="submit", where=str(self.node.plugin))
        source = self._sources[names] = Source(names, self.outputs)
        self._line_up(source)
        source.is_enabled = self.is_running and not self.is_draining
        # It has never been executed, and so goes before all that have.
        self._order = dict.fromkeys(
            sorted([*self._order, source], key=lambda hook: hook.executions > 0)
        )
        self.all_hooks.append(source)
        return source


def _turn(hook: Hook) -> int:
    return hook.turn


def _could_wake(hook: Hook) -> bool:
    """Whether it is ready, or could become so with no packet or acknowledgement of a neighbour."""
    if isinstance(hook, Source) and not hook.is_due:
        return False
    return hook.can_send() and all(slot.could_be_filled_from_outside() for slot in hook.slots)
