"""Time of a simulation: its steps, when sensors fire, and the thread that paces it.

Simulated time is never added up in floating point: it is the number of steps times the timestep,
a fraction, so a stamp after an hour is as exact as the first one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from functools import partial

from neuros.ports import Advance, NodeContext, Packet

_LARGEST_DENOMINATOR = 1_000_000
_TIMESTEP_TOLERANCE = Fraction(1, 10_000_000)
_PERIOD_TOLERANCE = Fraction(1, 1_000_000)
_MAX_LAG_S = 0.5
_JOIN_S = 5.0
_IDLE_S = 0.1
_PAUSED_S = 0.005


class Timebase:
    """Converts steps to time for one timestep, in seconds.

    A timestep in whole nanoseconds is exact as written (``0.002`` is 1/500); a rounded
    ``0.0041666667`` means 1/240.

    Attributes:
        timestep_s: the float nearest to the exact timestep.
    """

    def __init__(self, timestep_s: float) -> None:
        exact = Fraction(repr(float(timestep_s)))
        if (exact * 1_000_000_000).denominator != 1:
            near = exact.limit_denominator(_LARGEST_DENOMINATOR)
            exact = near if abs(near - exact) <= exact * _TIMESTEP_TOLERANCE else exact
        self._step = exact
        self._numerator, self._denominator = self._step.as_integer_ratio()
        self.timestep_s = float(self._step)

    def seconds(self, steps: int) -> float:
        """The time after ``steps``, correctly rounded."""
        return steps * self._numerator / self._denominator

    def nanoseconds(self, steps: int) -> int:
        """The time after ``steps`` in whole nanoseconds, halves rounded up."""
        twice = 2 * steps * self._numerator * 1_000_000_000 + self._denominator
        return twice // (2 * self._denominator)

    def period_steps(self, rate_hz: float) -> int:
        """Steps between two firings at ``rate_hz``; ``ValueError`` if not a whole number."""
        steps = 1 / (Fraction(repr(float(rate_hz))) * self._step)
        whole = max(1, round(steps))
        if abs(steps - whole) <= _PERIOD_TOLERANCE * steps:
            return whole
        below = max(1, int(steps))
        nearest = " and ".join(
            f"{float(1 / (count * self._step)):.10g} Hz (every {count} steps)"
            for count in sorted({below, below + 1})
        )
        raise ValueError(
            f"{rate_hz:g} Hz is a period of {float(steps):.6g} timesteps of {self.timestep_s:g} s, "
            f"which is not a whole number; the nearest rates are {nearest}"
        )


class FiringSchedule:
    """The firings of sensors: every ``periods[name]`` steps, first after one period."""

    def __init__(self, periods: Mapping[str, int]) -> None:
        self._periods = dict(periods)
        self._last: tuple[int, int | None] = (-1, None)  # the answer to the last question

    def next_firing(self, step: int) -> int | None:
        """The first step after ``step`` at which any sensor fires; ``None`` without sensors."""
        if step == self._last[0]:
            return self._last[1]
        found = None
        for period in self._periods.values():  # a comprehension takes twice as long
            firing = step - step % period + period
            if found is None or firing < found:
                found = firing
        self._last = (step, found)
        return found

    def due(self, step: int) -> tuple[str, ...]:
        """The sensors that fire at ``step``, in the order of their declaration."""
        found: tuple[str, ...] = ()
        for name, period in self._periods.items() if step else ():
            if step % period == 0:
                found += (name,)
        return found

    def find_crossing(
        self, unread: Collection[str], step: int, target: int
    ) -> tuple[str, int, int] | None:
        """A sensor that would lose a packet between ``step`` and ``target``, or ``None``.

        A sensor loses one if it fires while its packet is unread, or twice. Returns its name and
        the steps of the two firings.
        """
        for name, period in self._periods.items():
            last = step - step % period
            first = last if name in unread else last + period
            if first + period <= target:
                return name, first, first + period
        return None

    def __contains__(self, name: object) -> bool:
        return name in self._periods

    def __iter__(self) -> Iterator[str]:
        return iter(self._periods)


class Pacer:
    """Holds a simulation back to ``factor`` simulated seconds per wall second.

    Waits are measured against a fixed origin, so that their errors do not add up: after a late wait
    the simulation catches up. A lag beyond ``max_lag_s`` is dropped, so that the simulation does
    not race after a long stall. With ``factor`` ``None`` the pacer never waits.
    """

    def __init__(
        self,
        factor: float | None,
        clock: Callable[[], float],
        wait: Callable[[float], object],
        max_lag_s: float = _MAX_LAG_S,
    ) -> None:
        self._factor, self._clock, self._wait, self._max_lag_s = factor, clock, wait, max_lag_s
        self._origin: float | None = None

    def restart(self) -> None:
        """Set a new origin at the next call, after a pause or reset; from any thread."""
        self._origin = None

    def start(self, sim_time_s: float) -> None:
        """Set the origin so that ``sim_time_s`` is due now."""
        if self._factor is not None:
            self._origin = self._clock() - sim_time_s / self._factor

    def hold(self, sim_time_s: float) -> None:
        """Wait until ``sim_time_s`` is due."""
        early_s = self.early_s(sim_time_s)
        if early_s > 0:
            self._wait(early_s)

    def early_s(self, sim_time_s: float) -> float:
        """Seconds until ``sim_time_s`` is due; 0 if it is due, or the pacer never waits."""
        if self._factor is None:
            return 0.0
        origin = self._origin  # read once: another thread may call restart
        if origin is None:
            self.start(sim_time_s)
            return 0.0
        early_s = origin + sim_time_s / self._factor - self._clock()
        if -early_s > self._max_lag_s:
            self._origin = origin - early_s - self._max_lag_s
        return max(0.0, early_s)


class StepLock:
    """Lock of model and data: the stepping thread holds it bout by bout, and visitors go first.

    It also holds the pause, in which no step begins but those that are granted. A plain lock would
    starve visitors: the stepping thread would acquire it again at once.
    """

    def __init__(self) -> None:
        self._granted = 0
        self._changed = threading.Condition()
        self._one_visitor = threading.RLock()
        self._visitors = 0
        self._is_stepping = False
        self.is_paused = False

    @contextmanager
    def visit(self) -> Iterator[None]:
        """Exclude steps and other threads' visits; nests."""
        with self._one_visitor:
            with self._changed:
                self._visitors += 1
                self._changed.wait_for(lambda: not self._is_stepping)
            try:
                yield
            finally:
                with self._changed:
                    self._visitors -= 1
                    self._changed.notify_all()

    def pause(self) -> None:
        """Keep further steps from beginning until :meth:`resume`; returns at once."""
        self.is_paused = True

    def resume(self) -> None:
        with self._changed:
            self.is_paused = False
            self._changed.notify_all()

    def grant(self, count: int, cancelled: Callable[[], bool]) -> int:
        """Let ``count`` steps begin in the pause, and wait until they have ended.

        Returns those that are missing, once ``cancelled()``, or if the pause ends before.
        """
        with self._changed:
            self._granted = count
            self._changed.notify_all()
            while self._granted and self.is_paused and not cancelled():
                self._changed.wait(_IDLE_S)
            missing, self._granted = self._granted, 0
            return missing

    def allowed(self, count: int) -> int:
        """How many of ``count`` steps the pause allows now."""
        return min(count, self._granted) if self.is_paused else count

    def use(self, count: int) -> None:
        """So many steps have been made, in a bout."""
        self._granted = max(0, self._granted - count)

    def wake(self) -> None:
        """Make every waiting thread check its condition again."""
        with self._changed:
            self._changed.notify_all()

    def wait_resumed(self, seconds: float) -> None:
        """Wait until stepping is resumed, at most ``seconds``, or until :meth:`wake`."""
        with self._changed:
            if self.is_paused:
                self._changed.wait(seconds)

    def enter(self, cancelled: Callable[[], bool], seconds: float | None = None) -> bool:
        """Begin a bout of steps as soon as no visitor is in and stepping is not paused.

        Returns False, without having begun, once ``cancelled()``, or after ``seconds`` of waiting.
        """
        with self._changed:
            may_try = self._changed.wait_for(
                lambda: cancelled() or not (self._visitors or not self.allowed(1)), seconds
            )
            if cancelled() or not may_try:
                return False
            self._is_stepping = True
            return True

    def leave(self) -> None:
        with self._changed:
            self._is_stepping = False
            self._changed.notify_all()


class FreeRun:
    """A thread that runs a bout of steps, waits for the wall clock, and sends due packets, in turn.

    It begins at time 0 of the run, and ends when the simulated time of the run is over. Sending
    waits while a reliable connection is blocked; visitors of the lock may use model and data
    meanwhile. An error ends the node. In virtual time there is no thread: events of the node do
    this, at the times of the virtual clock. In a replay, the node advances the world.

    Args:
        advance: runs one bout and returns the packets that are due after it, by output.
        sim_time: simulated seconds.
        finish: called in the thread at its end.
        idle: called every 0.1 s while stepping is paused; ``None``: nothing.
        clock: wall seconds.
        wait: sleeps that many seconds; by default :meth:`stop` ends the sleep.
    """

    def __init__(
        self,
        node: NodeContext,
        lock: StepLock,
        advance: Advance,
        sim_time: Callable[[], float],
        finish: Callable[[], None],
        idle: Callable[[], None] | None,
        factor: float | None,
        clock: Callable[[], float],
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self._node, self._lock = node, lock
        self._advance, self._sim_time, self._finish = advance, sim_time, finish
        self._idle = idle
        self._stopped = threading.Event()
        self._virtual = node.virtual_time
        self._is_without_thread = False
        if self._virtual is not None:
            clock = self._virtual.clock_s
        self.pacer = Pacer(factor, clock, wait or self._stopped.wait)
        self._thread = threading.Thread(
            target=self._run, name=f"{node.name}: simulation", daemon=True
        )

    @property
    def is_running(self) -> bool:
        is_alive = self._is_without_thread or self._thread.is_alive()
        return is_alive and not self._stopped.is_set()

    def start(self) -> None:
        self._is_without_thread = self._node.drive(self._advance) or self._virtual is not None
        if not self._is_without_thread:
            self._thread.start()
        elif self._virtual is not None:
            self._virtual.when_active(self._start_in_virtual_time)

    def stop(self) -> None:
        """End the thread and wait for its end; callable again, and in the thread itself."""
        self._stopped.set()
        self._lock.wake()
        is_own = self._thread is threading.current_thread()
        if not self._is_without_thread and not is_own:
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            if self._node.wait_until_active(self._stopped.is_set):
                self.pacer.start(self._sim_time())
                while self._bout():
                    pass
        except BaseException as error:
            if not self._stopped.is_set():
                self._node.fail(error)
        finally:
            self._stopped.set()
            self._finish()

    def _bout(self) -> bool:
        cancelled = self._stopped.is_set
        while not self._lock.enter(cancelled, None if self._idle is None else _IDLE_S):
            if cancelled():
                return False
            if self._idle is not None:
                self._idle()
        try:
            packets = self._advance()
        finally:
            self._lock.leave()
        self.pacer.hold(self._sim_time())
        may_go_on = not packets or self._node.submit(packets, cancelled)
        return may_go_on and self._node.note_simulated_time()

    def _start_in_virtual_time(self) -> None:
        self.pacer.start(self._sim_time())
        self._bout_in_virtual_time()

    def _bout_in_virtual_time(self) -> None:
        """Run a bout; what is due after it leaves when the virtual clock has come that far."""
        virtual = self._virtual
        if virtual is None or self._stopped.is_set():
            return
        now_s = virtual.clock_s()
        if self._lock.is_paused:
            virtual.call_at(now_s + _PAUSED_S, self._bout_in_virtual_time)
            return
        with self._lock.visit():
            packets = self._advance()
        due_s = now_s + self.pacer.early_s(self._sim_time())
        virtual.call_at(due_s, partial(self._send_in_virtual_time, packets))

    def _send_in_virtual_time(self, packets: Mapping[str, Packet]) -> None:
        if self._virtual is None or self._stopped.is_set():
            return
        if packets:
            self._virtual.send(packets, self._go_on_in_virtual_time)
        else:
            self._go_on_in_virtual_time()

    def _go_on_in_virtual_time(self) -> None:
        if self._node.note_simulated_time():
            self._bout_in_virtual_time()
