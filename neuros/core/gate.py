"""A pause: the hooks of a node stand still, but for single steps.

A step of a synchronous simulation is one start of each hook that drives it: one that needs no
packet (a main loop, a tick, the thread of a simulator). The other hooks answer what they receive,
until nothing is left to answer. In a project that nothing drives (two players and a ball), each
hook starts once.

Ticks have a time of their own, which stands still meanwhile: none is missed by a pause.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from neuros.core.accounting import PAUSED, SCHEDULING, Rest
from neuros.core.hook import Hook
from neuros.core.life import Life
from neuros.hooks import HookKind


class Gate:
    """Lets hooks through to the engine, or not.

    Attributes:
        is_closed: whether the node is paused.
    """

    def __init__(self, life: Life, ticks: Sequence[Hook]) -> None:
        self._life = life
        self._ticks = ticks
        self._since_ns = 0
        self._granted = 0
        self._started: dict[Hook, int] = {}
        self._limits_all = False
        self.is_closed = False

    def close(self, now_ns: int) -> None:
        """Pause; a second time has no effect."""
        if not self.is_closed:
            self.is_closed, self._since_ns = True, now_ns
            self._granted = 0
            self._started.clear()

    def open(self, now_ns: int) -> None:
        """Go on, as if no time had passed for ticks."""
        if not self.is_closed:
            return
        self.is_closed = False
        if not self._life.is_running:
            return
        paused_ns = now_ns - max(self._since_ns, self._life.tick_start_ns)
        self._life.tick_start_ns += paused_ns
        for hook in self._ticks:
            hook.postpone(paused_ns)
            hook.is_due = hook.due_ns <= now_ns  # a step may have made it due before its time

    def grant(self, steps: int, *, is_driven: bool) -> None:
        """Allow further steps; ``is_driven``: some node of the project has hooks that drive."""
        if not self.is_closed:
            return
        self._granted += steps
        self._limits_all = not is_driven
        for hook in self._ticks:
            if hook.is_enabled and self.lets(hook):
                hook.is_due = True

    def lets(self, hook: Hook) -> bool:
        """Whether a hook may start now, as far as pauses are concerned."""
        if not self.is_closed or hook.spec.kind is HookKind.INITIALISE:
            return True
        if self._limits_all or drives(hook):
            return self._started.get(hook, 0) < self._granted
        return self._granted > 0

    def cause_of_rest(self, candidates: Iterable[Hook]) -> Rest:
        """Why nothing runs while the gate is closed, unless something is about to."""
        may_start = any(self.lets(hook) and hook.can_send() for hook in candidates)
        return SCHEDULING if may_start else PAUSED

    def note(self, hook: Hook) -> None:
        """A hook starts while the gate is closed."""
        started = self._started[hook] = self._started.get(hook, 0) + 1
        if hook.period_ns:
            hook.is_due = started < self._granted


def drives(hook: Hook) -> bool:
    """Whether a hook starts again and again with no packet for it."""
    kind = hook.spec.kind
    is_main_loop = all(port.is_optional for port in hook.spec.inputs)
    return kind is HookKind.TICK or (kind is HookKind.FUNCTION and is_main_loop)
