"""Which hooks of a node may start, in what order, and what they wait for.

Order: least recently executed first, before any execution in the order of declaration. ``order``
has all hooks, for questions about what the node waits for. An event reads only ``candidates``, the
hooks that are enabled, due and have all inputs, and compares their ``turn``: it costs the same
beside 2 or 200 resting hooks. Each hook adds and removes itself there.

Phases: registering (until every receiver is there), initialising (until each initialise hook has
run, and every node of the project is ready), running, draining (without the hooks that send
unasked; hooks of an endless loop start at most once more), stopped. Each phase enables some hooks;
a pause lets them start in steps only.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

from neuros.engine.connection_ends import SendWindow
from neuros.engine.hook import Hook, Source
from neuros.engine.metrics import IDLE, PAUSED, SCHEDULING, Rest
from neuros.hooks import HookKind
from neuros.project.model import Connection

FIRST_TURN = -(2**62)
"""There will be fewer hooks and executions."""

_LAST_STILL = 16

MOST_EXECUTIONS = 10_000
"""240 kB, freed as soon as they are written."""


class Schedule:
    """The hooks that may still run.

    Attributes:
        order: all hooks, least recently executed first.
        candidates: the hooks that may run now, unless an output is blocked.
        last_turn: the last one that was given to a hook that has started.
        new_turn: the next one that a hook is given before its first start.
    """

    def __init__(self) -> None:
        self.order: dict[Hook, None] = {}
        self.candidates: set[Hook] = set()
        self.last_turn = 0
        self.new_turn = FIRST_TURN

    def add(self, hook: Hook) -> None:
        """Insert a new hook before all executed hooks, and behind the others."""
        hook.candidates = self.candidates
        hook.turn = self.new_turn
        self.new_turn += 1
        self.order = dict.fromkeys(sorted([*self.order, hook], key=_turn))

    def remove(self, hook: Hook) -> None:
        """Remove a hook that will never run again."""
        del self.order[hook]

    def move_to_end(self, hook: Hook) -> None:
        """Give a hook that starts now the last place."""
        del self.order[hook]
        self.order[hook] = None
        self.last_turn += 1
        hook.turn = self.last_turn

    # ------------------------------------------------------------------ questions

    def rest(self) -> Rest:
        """The cause of rest: a blocked output, else a missing input, else a clock. Any thread.

        ``SCHEDULING`` if a hook can run: it will at the next event.
        """
        waiting: Rest | None = None
        blocked: Rest | None = None
        for hook in self.order:
            if not hook.is_open:
                continue
            hook_input = hook.awaited_input()
            if hook_input is not None:
                if waiting is None:
                    waiting = hook_input.rest
            elif hook.can_send():
                return SCHEDULING
            elif blocked is None:
                blocked = hook.blocking_windows()[0].rest
        return blocked or waiting or IDLE

    def cause_of_rest(self) -> Rest:
        """As :meth:`rest`, for the engine's own thread, and faster: reads candidates first."""
        if not self.candidates:
            for hook in self.order:
                if hook.is_open:
                    for hook_input in hook.inputs:
                        if hook_input.missing:
                            return hook_input.rest
            return IDLE
        for hook in self.candidates:
            if not hook.blocked or hook.can_send():
                return SCHEDULING
        first = min(self.candidates, key=_turn)
        return first.blocking_windows()[0].rest

    def has_ready_hook(self) -> bool:
        """Whether some hook could start now."""
        return any(hook.is_ready() for hook in self.order)

    def has_startable_packet(self) -> bool:
        """Whether some hook could start now on a packet of a reliable connection."""
        return any(hook.has_reliable_packet() and hook.is_ready() for hook in self.order)

    def is_wakeable(self) -> bool:
        """Whether a hook is ready, or a timer or an external topic could make one so."""
        return any(
            hook.is_enabled
            and (hook.is_due or not isinstance(hook, Source))
            and hook.can_send()
            and all(hook_input.could_be_filled_from_outside() for hook_input in hook.inputs)
            for hook in self.order
        )

    def free_running_hooks(self) -> list[Hook]:
        """Function hooks without required inputs: only blocked outputs hold them up."""
        return [
            hook
            for hook in self.order
            if hook.spec.kind is HookKind.FUNCTION
            and not isinstance(hook, Source)
            and all(hook_input.is_optional for hook_input in hook.inputs)
        ]


def _turn(hook: Hook) -> int:
    return hook.turn


class Lifecycle:
    """Enables the hooks of a schedule, phase by phase.

    Attributes:
        has_begun: whether the node was started and every receiver has been found.
        is_ready: whether the node has reported that it is ready.
        is_active: whether every node of the project is ready.
        is_running: whether the node is active, and every initialise hook has run.
        last_round: while draining, the hooks that may start once more.
        tick_start_ns: the time at which it began to run; ticks count from there.
    """

    def __init__(
        self, schedule: Schedule, windows: Mapping[Connection, SendWindow], clock: Callable[[], int]
    ) -> None:
        self._schedule = schedule
        self._windows = windows
        self._clock = clock
        self._unregistered = sum(not window.is_registered for window in windows.values())
        self._initialisers = {h for h in schedule.order if h.spec.kind is HookKind.INITIALISE}
        self.is_started = False
        self.has_begun = False
        self.is_ready = False
        self.is_active = False
        self.is_running = False
        self.is_draining = False
        self.is_stopped = False
        self.last_round: set[Hook] = set()
        self.tick_start_ns = 0

    @property
    def awaits_others(self) -> bool:
        """Whether the node has initialised, and another one is not ready."""
        return self.has_begun and not self.is_active and not self._initialisers

    def start(self, *, awaits_others: bool) -> None:
        """Enable the initialise hooks as soon as every receiver is there."""
        self.is_started = True
        self.is_active = not awaits_others
        self._begin_if_registered()

    def activate(self) -> None:
        """Every node of the project is ready."""
        self.is_active = True
        self._run_if_initialised()

    def register(self, connection: Connection) -> None:
        window = self._windows[connection]
        if not window.is_registered:
            window.is_registered = True
            self._unregistered -= 1
            self._begin_if_registered()

    def finish_initialiser(self, hook: Hook) -> None:
        """Remove an initialise hook that has run."""
        hook.is_enabled = False
        self._schedule.remove(hook)
        self._initialisers.remove(hook)
        self._run_if_initialised()

    def drain(self, last_round: Iterable[Hook]) -> None:
        """Disable the hooks that send unasked; hooks of ``last_round`` may start once more."""
        self.is_draining = True
        self.last_round.update(last_round)
        for hook in self._schedule.order:
            if hook.spec.sends_unasked:
                hook.is_enabled = False

    def finish_round(self, hook: Hook) -> None:
        """Disable a hook of the last round that has started: its further packets stay unread."""
        self.last_round.discard(hook)
        hook.is_enabled = False

    def add_source(self, source: Source) -> None:
        """Add the source of a thread of the plugin, which sends for the first time."""
        self._schedule.add(source)
        source.is_enabled = self.is_running and not self.is_draining

    def _begin_if_registered(self) -> None:
        if not self.is_started or self._unregistered or self.has_begun:
            return
        self.has_begun = True
        for hook in self._initialisers:
            hook.is_enabled = self._goes_on(hook)
        self._run_if_initialised()

    def _run_if_initialised(self) -> None:
        if not (self.has_begun and self.is_active) or self._initialisers or self.is_running:
            return
        self.is_running = True
        self.tick_start_ns = self._clock()
        for hook in self._schedule.order:
            hook.is_enabled = self._goes_on(hook)
            if hook.period_ns:
                hook.set_due(self.tick_start_ns, self.tick_start_ns)

    def _goes_on(self, hook: Hook) -> bool:
        return not (self.is_draining and hook.spec.sends_unasked)


class Pause:
    """A pause of the node: hooks start in single steps only.

    In a step, each hook that drives the project (a main loop, a tick, the thread of a simulator)
    starts once. The other hooks answer their packets until none is left. In a project that nothing
    drives (two players and a ball), each hook starts once. The world outside does not pause: its
    packets that arrive after the begin of a step wait for the next one, else a step might not end.

    The time of ticks stands still in a pause, so that none is missed.

    Attributes:
        is_on: whether the node is paused.
        still_ns: start and end of each time without a hook of a step, one after the other. The
            latency of a packet does not count these times. The packet log empties the array.
        last_still_ns: the last few of these times.
        is_still: whether no hook starts before another step is granted, or the pause ends.
    """

    def __init__(self, lifecycle: Lifecycle, ticks: Sequence[Hook]) -> None:
        self._lifecycle = lifecycle
        self._arrived = 0
        self._ticks = ticks
        self._since_ns = 0
        self._granted = 0
        self._started: dict[Hook, int] = {}
        self._limits_all = False
        self._still_since_ns: int | None = None
        self.still_ns = array("q")
        self.last_still_ns: deque[tuple[int, int]] = deque(maxlen=_LAST_STILL)
        self.is_on = self.is_still = False

    def begin(self, now_ns: int) -> None:
        """Pause, if it is not paused already; the steps that are left are revoked."""
        if not self.is_on:
            self.is_on, self._since_ns = True, now_ns
            self._still_since_ns = now_ns
        self.revoke()

    def revoke(self) -> None:
        self._granted = 0
        self._started.clear()
        self.is_still = self._lifecycle.is_running and self._still_since_ns is not None

    def end(self, now_ns: int) -> None:
        """End the pause; for ticks, no time has passed."""
        if not self.is_on:
            return
        self.is_on = self.is_still = False
        if self._still_since_ns is not None:
            self._end_standstill(self._still_since_ns, now_ns)
        if not self._lifecycle.is_running:
            return
        paused_ns = now_ns - max(self._since_ns, self._lifecycle.tick_start_ns)
        self._lifecycle.tick_start_ns += paused_ns
        for hook in self._ticks:
            hook.postpone(paused_ns)
            hook.is_due = hook.due_ns <= now_ns  # a step may have made it due before its time

    def grant(self, steps: int, arrivals: int, *, is_driven: bool) -> None:
        """Allow further steps.

        Args:
            arrivals: the number of packets that have arrived at the node.
            is_driven: whether some node of the project has driving hooks.
        """
        if self.is_on:
            self.is_still = False
            self._granted += steps
            self._arrived = arrivals
            self._limits_all = not is_driven

    def wake_ticks(self) -> None:
        """Make ticks due that have steps left."""
        for hook in self._ticks if self._granted else ():
            if hook.is_enabled and self.allows(hook):
                hook.is_due = True

    def allows(self, hook: Hook) -> bool:
        """Whether the pause lets a hook start now."""
        if not self.is_on or hook.spec.kind is HookKind.INITIALISE:
            return True
        if self._limits_all or hook.drives:
            return self._started.get(hook, 0) < self._granted
        return self._granted > 0 and all(port.has_waited(self._arrived) for port in hook.inputs)

    def cause_of_rest(self, candidates: Iterable[Hook], now_ns: int) -> Rest:
        """``PAUSED``, or ``SCHEDULING`` if a hook of a step is about to start."""
        for hook in candidates:  # any() over a generator takes thrice as long
            if self.allows(hook) and hook.can_send():
                return SCHEDULING
        if self._still_since_ns is None:
            self._still_since_ns = now_ns
        return PAUSED

    def _end_standstill(self, since_ns: int, now_ns: int) -> None:
        """End the time in which the node stands still."""
        times_ns = since_ns, now_ns
        self.last_still_ns.append(times_ns)
        self.still_ns.extend(times_ns)
        self._still_since_ns = None

    def record_start(self, hook: Hook, now_ns: int, arrivals: int) -> None:
        """Count the start of a hook in the pause; ``arrivals`` as of :meth:`grant`."""
        if (since_ns := self._still_since_ns) is not None:
            self._end_standstill(since_ns, now_ns)
        started = self._started[hook] = self._started.get(hook, 0) + 1
        if hook.drives:
            self._arrived = arrivals
        if hook.period_ns:
            hook.is_due = started < self._granted


class ExecutionLog:
    """The first executions of a node's hooks, and the acknowledgements that came meanwhile.

    The metrics of a run are sums; single executions show how hooks and packets interlock. A full
    log costs nothing.

    Attributes:
        is_full: whether recording has ended.
        hooks: name and kind of each hook that has run, in the order of first executions.
        executions: place in ``hooks``, start and end (ns), one after the other.
        credits: index of a connection, acknowledged position and time (ns), one after the other.
    """

    __slots__ = ("_left", "_places", "credits", "executions", "hooks", "is_full")

    def __init__(self, most: int = MOST_EXECUTIONS) -> None:
        self._left = most
        self._places: dict[Hook, int] = {}
        self.is_full = most <= 0
        self.hooks: list[tuple[str, str]] = []
        self.executions = array("q")
        self.credits = array("q")

    def record_execution(self, hook: Hook, start_ns: int, end_ns: int) -> None:
        place = self._places.get(hook)
        if place is None:
            place = self._places[hook] = len(self.hooks)
            self.hooks.append((hook.name, hook.spec.kind.value))
        self.executions.extend((place, start_ns, end_ns))
        self._left -= 1
        self.is_full = self._left <= 0

    def record_credit(self, connection: Connection, position: int, now_ns: int) -> None:
        self.credits.extend((connection.index, position, now_ns))
