"""The hooks of a node in the order of priority: whose turn it is, and who could run at all.

Least recently executed first, before any execution in the order of declaration. ``order`` has all
hooks, for whoever asks what the node waits for. An event looks only at ``candidates``, the hooks
that are enabled, due and have all inputs (each keeps itself in there), and compares their ``turn``:
so it costs the same beside 2 or 200 resting hooks.
"""

from __future__ import annotations

from collections.abc import Iterator

from neuros.core.accounting import IDLE, SCHEDULING, Rest
from neuros.core.hook import Hook, Source
from neuros.hooks import HookKind

_MANY = 2**62
"""More hooks and executions than there will be."""


class Schedule:
    """The hooks that may still run.

    Attributes:
        order: all of them, least recently executed first.
        candidates: those that only a blocked output could keep from running now.
    """

    def __init__(self) -> None:
        self.order: dict[Hook, None] = {}
        self.candidates: set[Hook] = set()
        self._turn = 0
        self._first_turn = -_MANY

    def add(self, hook: Hook) -> None:
        """Give a new hook its place: before all that have been executed, behind all others."""
        hook.candidates = self.candidates
        hook.turn = self._first_turn
        self._first_turn += 1
        self.order = dict.fromkeys(sorted([*self.order, hook], key=_turn))

    def remove(self, hook: Hook) -> None:
        """Forget a hook that will never run again."""
        del self.order[hook]

    def move_to_end(self, hook: Hook) -> None:
        """Note that a hook is executed now."""
        del self.order[hook]
        self.order[hook] = None
        self._turn += 1
        hook.turn = self._turn

    def one_pass(self) -> Iterator[Hook]:
        """The candidates in the order of priority that holds now, each looked for at its turn.

        Whatever runs in between may add and remove candidates. One comes up if it has not been
        passed by then: its turn is one that was given before the pass began, up to ``last`` to
        hooks that have been executed, below ``first_new`` to the others.
        """
        last, first_new, place = self._turn, self._first_turn, -_MANY - 1
        while self.candidates:
            found: Hook | None = None
            for hook in self.candidates:
                turn = hook.turn
                is_in_pass = place < turn <= last and (turn > 0 or turn < first_new)
                if is_in_pass and (found is None or turn < found.turn):
                    found = hook
            if found is None:
                return
            place = found.turn
            yield found

    # ------------------------------------------------------------------ questions

    def cause_of_rest(self) -> Rest:
        """As :func:`neuros.core.accounting.cause_of_rest`, without a look at all that only wait."""
        if not self.candidates:
            for hook in self.order:
                slot = hook.awaited_slot()
                if slot is not None:
                    return slot.rest
            return IDLE
        for hook in self.candidates:
            if not hook.blocked or hook.can_send():
                return SCHEDULING
        first = min(self.candidates, key=_turn)
        return first.blocking_outlets()[0].rest

    def has_ready_hook(self) -> bool:
        """Whether some hook could start now."""
        return any(hook.is_ready() for hook in self.order)

    def has_startable_packet(self) -> bool:
        """Whether some hook could start now on a packet of a reliable connection."""
        return any(hook.has_reliable_packet() and hook.is_ready() for hook in self.order)

    def is_wakeable(self) -> bool:
        """Whether a hook is ready, or a timer or an external topic could make one so."""
        return any(hook.is_enabled and _could_wake(hook) for hook in self.order)

    def free_running_hooks(self) -> list[Hook]:
        """Hooks that nothing but blocked outputs ever holds up."""
        return [
            hook
            for hook in self.order
            if hook.spec.kind is HookKind.FUNCTION
            and not isinstance(hook, Source)
            and all(slot.is_optional for slot in hook.slots)
        ]


def _turn(hook: Hook) -> int:
    return hook.turn


def _could_wake(hook: Hook) -> bool:
    """Whether it is ready, or could become so with no packet or acknowledgement of a neighbour."""
    if isinstance(hook, Source) and not hook.is_due:
        return False
    return hook.can_send() and all(slot.could_be_filled_from_outside() for slot in hook.slots)
