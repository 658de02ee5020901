"""The phases of a node's life: each lets some hooks run and others not.

Registering (until every receiver is there), initialising (until each initialise hook has run),
running, draining (without the hooks that send unasked; those that would go on for ever start once
more at most), stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from neuros.core.flow import Outlet
from neuros.core.hook import Hook, Source
from neuros.core.schedule import Schedule
from neuros.hooks import HookKind
from neuros.project.model import Connection


class Life:
    """Enables the hooks of a schedule, phase by phase.

    Attributes:
        has_begun: whether the node was started and every receiver has been found.
        is_running: whether every initialise hook has run.
        last_round: while draining, the hooks that may start once more and no more.
        tick_start_ns: when that was, on the clock; ticks are counted from then.
    """

    def __init__(
        self, schedule: Schedule, outlets: Mapping[Connection, Outlet], clock: Callable[[], int]
    ) -> None:
        self._schedule = schedule
        self._outlets = outlets
        self._clock = clock
        self._unregistered = sum(not outlet.is_registered for outlet in outlets.values())
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
        outlet = self._outlets[connection]
        if not outlet.is_registered:
            outlet.is_registered = True
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
