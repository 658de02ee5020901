"""An event loop and a clock that go only when a test tells them to."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

Event = Callable[[], None]


class ManualClock:
    """A monotonic clock in nanoseconds; it starts at 0."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


class StepLoop:
    """Handles events in the order in which they were posted (:class:`neuros.ports.EventLoop`).

    All packets travel through this one queue, so a loop-back needs no queue of its own to come
    after everything that waits.
    """

    has_taken_in = True

    def __init__(self, clock: ManualClock) -> None:
        self._clock = clock
        self._events: deque[Event] = deque()
        self._timers: list[tuple[Callable[[], int | None], Event]] = []
        self._is_stopping = False

    @property
    def has_waiting_events(self) -> bool:
        """Whether events wait."""
        return bool(self._events)

    def post(self, event: Event) -> None:
        """Handle ``event`` after all that already wait."""
        self._events.append(event)

    def post_loop_back(self, event: Event) -> None:
        """The same."""
        self._events.append(event)

    def note_execution(self) -> None:
        """Nothing has arrived meanwhile."""

    def post_from_thread(self, event: Event) -> None:
        """The same, from any thread; nobody is woken, since nobody waits."""
        self._events.append(event)

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        """Call ``on_due`` when :meth:`advance_to` reaches ``next_due_ns()``."""
        self._timers.append((next_due_ns, on_due))

    @property
    def next_due_ns(self) -> int | None:
        """When the next timer is due, ``None`` if none is."""
        dues = [due for next_due_ns, _ in self._timers if (due := next_due_ns()) is not None]
        return min(dues, default=None)

    def advance_to(self, time_ns: int) -> None:
        """Set the clock, and run the timers that are due then."""
        self._clock.now_ns = time_ns
        for next_due_ns, on_due in self._timers:
            due_ns = next_due_ns()
            if due_ns is not None and due_ns <= time_ns:
                on_due()

    def step(self) -> bool:
        """Handle the oldest event; returns False if there was none."""
        if self._is_stopping or not self._events:
            return False
        self._events.popleft()()
        return True

    def run(self) -> None:
        """Handle events until none is left, or until :meth:`stop`."""
        while self.step():
            pass

    def stop(self) -> None:
        """Handle no further event."""
        self._is_stopping = True
