"""The order of a node's hooks: the turn of each, what they wait for, and their first executions.

Least recently executed first, before any execution in the order of declaration. ``order`` has all
hooks, to tell what the node waits for. An event looks only at ``candidates``, the hooks
that are enabled, due and have all inputs (each keeps itself in there), and compares their ``turn``:
so it costs the same beside 2 or 200 resting hooks.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator

from neuros.engine.hook import Hook, Source
from neuros.engine.metrics import IDLE, SCHEDULING, Rest
from neuros.hooks import HookKind
from neuros.project.model import Connection

_MANY = 2**62
"""More hooks and executions than there will be."""

MOST_EXECUTIONS = 10_000
"""240 kB, which are freed as soon as they are written."""


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

        A hook that runs in between may add and remove candidates. One comes up if it has not been
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

    def rest(self) -> Rest:
        """The cause of its rest: a receiver, else a missing input, else only its clock. Any thread.

        A hook that could run (and will, at the next event) makes it ``SCHEDULING``. Before its time
        a tick hook waits for nothing but its clock.
        """
        waiting: Rest | None = None
        blocked: Rest | None = None
        for hook in self.order:
            if not (hook.is_enabled and hook.is_due):
                continue
            hook_input = hook.missing_input()
            if hook_input is not None:
                if waiting is None:
                    waiting = hook_input.rest
            elif hook.can_send():
                return SCHEDULING
            elif blocked is None:
                blocked = hook.blocking_windows()[0].rest
        return blocked or waiting or IDLE

    def cause_of_rest(self) -> Rest:
        """As :meth:`rest`, for the engine's own thread: it skips hooks that only wait."""
        if not self.candidates:
            for hook in self.order:
                hook_input = hook.awaited_input()
                if hook_input is not None:
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
        return any(hook.is_enabled and _could_wake(hook) for hook in self.order)

    def free_running_hooks(self) -> list[Hook]:
        """Hooks that nothing but blocked outputs ever holds up."""
        return [
            hook
            for hook in self.order
            if hook.spec.kind is HookKind.FUNCTION
            and not isinstance(hook, Source)
            and all(hook_input.is_optional for hook_input in hook.inputs)
        ]


def _turn(hook: Hook) -> int:
    return hook.turn


def _could_wake(hook: Hook) -> bool:
    """Whether it is ready, or could become so with no packet or acknowledgement of a neighbour."""
    if isinstance(hook, Source) and not hook.is_due:
        return False
    return hook.can_send() and all(
        hook_input.could_be_filled_from_outside() for hook_input in hook.inputs
    )


class ExecutionLog:
    """The first executions of a node's hooks, and the acknowledgements that came meanwhile.

    The metrics of a run are sums; single executions show how hooks and packets interlock. The first
    ones are enough for that, and a list that ends costs nothing afterwards.

    Attributes:
        is_full: whether nothing more is noted.
        hooks: name and kind of each hook that has run, in the order of first executions.
        executions: place in ``hooks``, start and end (ns), one after the other.
        credits: index of a connection, position that was acknowledged and when (ns), likewise.
    """

    __slots__ = ("_left", "_places", "credits", "executions", "hooks", "is_full")

    def __init__(self, most: int = MOST_EXECUTIONS) -> None:
        self._left = most
        self._places: dict[Hook, int] = {}
        self.is_full = most <= 0
        self.hooks: list[tuple[str, str]] = []
        self.executions = array("q")
        self.credits = array("q")

    def note_execution(self, hook: Hook, start_ns: int, end_ns: int) -> None:
        """A hook has run."""
        place = self._places.get(hook)
        if place is None:
            place = self._places[hook] = len(self.hooks)
            self.hooks.append((hook.name, hook.spec.kind.value))
        self.executions.extend((place, start_ns, end_ns))
        self._left -= 1
        self.is_full = self._left <= 0

    def note_credit(self, connection: Connection, position: int, now_ns: int) -> None:
        """An acknowledgement has arrived."""
        self.credits.extend((connection.index, position, now_ns))
