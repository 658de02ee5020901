"""The lifecycle of a node, phase by phase, and its pauses: each lets some hooks run, others not.

Registering (until every receiver is there), initialising (until each initialise hook has run),
running, draining (without the hooks that send unasked; those that would go on for ever start once
more at most), stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from neuros.engine.hook import Hook, Source
from neuros.engine.metrics import PAUSED, SCHEDULING, Rest
from neuros.engine.schedule import Schedule
from neuros.engine.send_window import SendWindow
from neuros.hooks import HookKind
from neuros.project.model import Connection


class Lifecycle:
    """Enables the hooks of a schedule, phase by phase.

    Attributes:
        has_begun: whether the node was started and every receiver has been found.
        is_running: whether every initialise hook has run.
        last_round: while draining, the hooks that may start once more and no more.
        tick_start_ns: the end of initialisation, on the clock; ticks are counted from then.
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
        self.is_running = False
        self.is_draining = False
        self.is_stopped = False
        self.last_round: set[Hook] = set()
        self.tick_start_ns = 0

    def start(self) -> None:
        """Run hooks from now on, as soon as every receiver is there."""
        self.is_started = True
        self._begin_if_registered()

    def register(self, connection: Connection) -> None:
        """The receiver of one of the outputs' connections is there."""
        window = self._windows[connection]
        if not window.is_registered:
            window.is_registered = True
            self._unregistered -= 1
            self._begin_if_registered()

    def finish_initialiser(self, hook: Hook) -> None:
        """An initialise hook has run: it never will again."""
        hook.is_enabled = False
        self._schedule.remove(hook)
        self._initialisers.remove(hook)
        if not self._initialisers:
            self._begin_running()

    def drain(self, last_round: Iterable[Hook]) -> None:
        """Stop the hooks that send unasked; the others go on, ``last_round`` for one start each."""
        self.is_draining = True
        self.last_round.update(last_round)
        for hook in self._schedule.order:
            if hook.spec.sends_unasked:
                hook.is_enabled = False

    def finish_round(self, hook: Hook) -> None:
        """A hook of the last round has started: what else arrives for it stays unread."""
        self.last_round.discard(hook)
        hook.is_enabled = False

    def add_source(self, source: Source) -> None:
        """A thread of the plugin sends for the first time."""
        self._schedule.add(source)
        source.is_enabled = self.is_running and not self.is_draining

    def _begin_if_registered(self) -> None:
        if not self.is_started or self._unregistered or self.has_begun:
            return
        self.has_begun = True
        for hook in self._initialisers:
            hook.is_enabled = self._goes_on(hook)
        if not self._initialisers:
            self._begin_running()

    def _begin_running(self) -> None:
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

    A step of a synchronous simulation is one start of each hook that drives it: one that needs no
    packet (a main loop, a tick, the thread of a simulator). The other hooks answer what they
    receive, until nothing is left to answer. In a project that nothing drives (two players and a
    ball), each hook starts once.

    Ticks have a time of their own, which stands still meanwhile: none is missed by a pause.

    Attributes:
        is_on: whether the node is paused.
    """

    def __init__(self, lifecycle: Lifecycle, ticks: Sequence[Hook]) -> None:
        self._lifecycle = lifecycle
        self._ticks = ticks
        self._since_ns = 0
        self._granted = 0
        self._started: dict[Hook, int] = {}
        self._limits_all = False
        self.is_on = False

    def begin(self, now_ns: int) -> None:
        """Pause; a second time has no effect."""
        if not self.is_on:
            self.is_on, self._since_ns = True, now_ns
            self._granted = 0
            self._started.clear()

    def end(self, now_ns: int) -> None:
        """Go on, as if no time had passed for ticks."""
        if not self.is_on:
            return
        self.is_on = False
        if not self._lifecycle.is_running:
            return
        paused_ns = now_ns - max(self._since_ns, self._lifecycle.tick_start_ns)
        self._lifecycle.tick_start_ns += paused_ns
        for hook in self._ticks:
            hook.postpone(paused_ns)
            hook.is_due = hook.due_ns <= now_ns  # a step may have made it due before its time

    def grant(self, steps: int, *, is_driven: bool) -> None:
        """Allow further steps; ``is_driven``: some node of the project has hooks that drive."""
        if not self.is_on:
            return
        self._granted += steps
        self._limits_all = not is_driven
        for hook in self._ticks:
            if hook.is_enabled and self.allows(hook):
                hook.is_due = True

    def allows(self, hook: Hook) -> bool:
        """Whether the pause lets a hook start now."""
        if not self.is_on or hook.spec.kind is HookKind.INITIALISE:
            return True
        if self._limits_all or drives(hook):
            return self._started.get(hook, 0) < self._granted
        return self._granted > 0

    def cause_of_rest(self, candidates: Iterable[Hook]) -> Rest:
        """``PAUSED``, or ``SCHEDULING`` if a hook of a step is about to start."""
        may_start = any(self.allows(hook) and hook.can_send() for hook in candidates)
        return SCHEDULING if may_start else PAUSED

    def note_start(self, hook: Hook) -> None:
        """A hook starts while the node is paused."""
        started = self._started[hook] = self._started.get(hook, 0) + 1
        if hook.period_ns:
            hook.is_due = started < self._granted


def drives(hook: Hook) -> bool:
    """Whether a hook starts again and again with no packet for it."""
    kind = hook.spec.kind
    is_main_loop = all(port.is_optional for port in hook.spec.inputs)
    return kind is HookKind.TICK or (kind is HookKind.FUNCTION and is_main_loop)
