"""The event loop of a process: one thread and one queue for events of ROS and of the engines.

It serves ROS with one of two executors of rclpy; ``NEUROS_EXECUTOR`` chooses. ``events``, the
default, is the ``EventsExecutor``, one queue in C++. It is in rclpy's *experimental* package:
should a release move or change it, the loop falls back to ``wait_set``, on the public parts of
``SingleThreadedExecutor``. That one builds a new wait set for every callback: a round trip takes
two to three times as long, in an equal order of events.

Two habits of the ``EventsExecutor`` shape this module: without a finite timeout it spins hot, and
past its deadline it goes on while events keep coming. So it is always given a deadline, and is
stopped from inside when a timer is due.

Events of the engines wait in a deque of their own, since passing each of them through C++ would
cost more than the engine itself. One turn in the executor's queue stands for them, so that both
queues take turns. A loop-back is only handled first thing in a turn: then everything
that ROS had waiting when it was posted has been seen.

Arrivals come first. While a hook runs, rclpy queues an event for each packet, acknowledgement and
callback. If each of them let the next hook start, more would arrive than are handled, and hooks
would work on what is older and older. So after a hook, or a callback of a plugin, a turn is put
behind all that has arrived meanwhile, and no hook starts before it. Where nothing has arrived it
comes at once, while the node waits for others: a round trip takes no longer for it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ConditionReachedException, SingleThreadedExecutor, TimeoutException
from rclpy.logging import get_logger
from rclpy.node import Node as RosNode
from rclpy.timer import Timer

from neuros.errors import EnvironmentFault
from neuros.transport.rclpy_patches import OnFailure, Turn, own_tasks

Event = Callable[[], None]

EXECUTOR_VARIABLE = "NEUROS_EXECUTOR"
"""``events`` or ``wait_set``; unset, the first that works."""

_SERVICE_DEPTH = 10

# How long events of engines may keep those of ROS waiting, besides the event that runs. A turn
# costs 2 to 10 us, and 40 after a hook that has used up the caches. So it is 1 ms, or as long as a
# few of the long hooks that ROS has to wait for anyway; where hooks have periods always 1 ms.
_TURN_NS = 1_000_000
_LONGEST_TURN_NS = 10_000_000
_EVENTS = 8
# Between two events the executor releases Python's global lock and takes it again at once. A thread
# that waits for the lock is woken each time, in vain, and never has waited for the 5 ms after which
# Python would make this thread give it up. So a loop without pause would keep the thread of the
# control channel from its work for seconds. It sleeps for a moment now and then, if it has been
# running for most of the time since the last look.
_CHECK_NS = 50_000_000
_MOST_BUSY = 0.8
_GAP_S = 50e-6
_LONG_S = 3600.0
_TAKE_IN_S = 0.5


class _Waker:
    """Looks like a future to the executor and keeps what stops it: spinning ends on demand."""

    def __init__(self) -> None:
        self.wake: Callable[[Any], None] = lambda _: None

    def add_done_callback(self, callback: Callable[[Any], None]) -> None:
        self.wake = callback

    def remove_done_callback(self, callback: Callable[[Any], None]) -> None:
        """Keep it: it may be called from another thread between two spins, and then counts."""


class RosLoop:
    """Runs events of ROS, engines and timers, oldest first (:class:`neuros.ports.EventLoop`).

    ``on_failure`` gets the errors of events, in the loop's thread.

    Attributes:
        has_taken_in: whether all that ROS had waiting when a hook or callback ended is handled.
        turns: how many turns the events of engines have had.
    """

    waits_for = ""

    def __init__(self, context: Context, on_failure: Callable[[BaseException], None]) -> None:
        self.clock = time.monotonic_ns
        self._executor = make_executor(context, on_failure)
        self._on_failure = on_failure
        self._waker = _Waker()
        self._events: deque[tuple[Event, bool]] = deque()
        self._turn = Turn(self._run_turn)
        self._has_posted_turn = False
        self._is_turn_stale = False
        self.has_taken_in = True
        self._has_arrivals = False
        self.turns = 0
        self._ros_timers: list[Timer] = []
        self._timers: list[tuple[Callable[[], int | None], Event]] = []
        self._planned_ns: int | None = None
        self._has_older_events = False
        self._is_stopping = False
        self._checked_ns = 0
        self._busy_ns = 0  # processor time of this thread at the last look

    @property
    def is_limited(self) -> bool:
        """Whether guard conditions, and coroutines as callbacks of services, are not served."""
        return not isinstance(self._executor, WaitSetExecutor)

    def add_node(self, node: RosNode) -> None:
        """Serve what exists, and what will be created, on a ROS node."""
        self._executor.add_node(node)

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        self._timers.append((next_due_ns, on_due))

    def every(self, node: RosNode, seconds: float, event: Event) -> Timer:
        """Handle ``event`` again and again, by a timer of ROS that no simulated time stops."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        return node.create_timer(seconds, lambda: self.guard(event), clock=steady)

    def expect_arrivals(self) -> None:
        """From now on, ROS brings what hooks wait for, and not the nodes of this process alone."""
        self._has_arrivals = True

    def note_execution(self) -> None:
        """A hook or callback has ended: what has arrived until now comes before the next hook.

        Callbacks that are taken in then put that off no further, however many keep coming.
        """
        if self._ros_timers:
            # Queue callbacks of timers that are due, before the turn in which the next hook starts.
            for timer in [*self._ros_timers]:
                try:
                    if timer.is_ready():
                        timer.handle.call_timer()
                        self._executor.create_task(_call_back, timer)
                except InvalidHandle:  # the plugin has destroyed it
                    self._ros_timers.remove(timer)
        if not (self._has_arrivals and self.has_taken_in):
            return
        self.has_taken_in = False
        if self._has_posted_turn:
            self._is_turn_stale = True
        else:
            self._has_posted_turn = True
            self._executor.create_task(self._turn)

    def add_ros_timer(self, timer: Timer) -> None:
        """Call back a timer of a plugin after the hook during which it becomes due.

        The executor puts an event behind all that wait when the timer becomes due, and the callback
        behind all that wait then. With a hook before each, the timer would miss its next time.
        """
        if self.is_limited:  # a wait set has timers before all else
            self._ros_timers.append(timer)

    def remove_ros_timer(self, timer: Timer) -> None:
        """The timer is going to be destroyed."""
        if timer in self._ros_timers:
            self._ros_timers.remove(timer)

    @property
    def has_waiting_events(self) -> bool:
        return bool(self._events)

    def post(self, event: Event) -> None:
        self._events.append((event, False))
        if not self._has_posted_turn:
            self._post_turn()

    def post_loop_back(self, event: Event) -> None:
        self._events.append((event, True))
        if not self._has_posted_turn:
            self._post_turn()

    def post_from_thread(self, event: Event) -> None:
        self._executor.create_task(self.guard, event)

    def guard(self, event: Event) -> None:
        """Run what ROS calls: a failure must not unwind through the executor's C++."""
        try:
            event()
        except BaseException as error:
            self._on_failure(error)
        if self._timers:
            self._check_timers()

    def guarded(self, receive: Callable[..., None]) -> Callable[..., None]:
        """Wrap a function that ROS calls with a message again and again, as :meth:`guard` does.

        It may take what ROS knows of the message, too: ``receive(message, info)``.
        """
        on_failure, timers = self._on_failure, self._timers

        @functools.wraps(receive)  # rclpy asks for its signature
        def guarded(*message: Any) -> None:
            try:
                receive(*message)
            except BaseException as error:
                on_failure(error)
            if timers:
                self._check_timers()

        return guarded

    def run(self) -> None:
        """Run until :meth:`stop`.

        Where a timer is overdue, and one may always be, what waits is handled before it: all of it,
        or as much as the first hook that takes longer than a turn.
        """
        while not self._is_stopping:
            self._planned_ns = self._next_due_ns()
            if self._planned_ns is None:
                wait_s = _LONG_S
            else:
                wait_s = (self._planned_ns - time.monotonic_ns()) / 1e9
            if wait_s <= 0:
                wait_s = _LONG_S
                self._has_older_events = True
                self.post(self._end_older_events)
            self._executor.spin_until_future_complete(self._waker, wait_s)
            now_ns = time.monotonic_ns()
            for next_due_ns, on_due in self._timers:
                due_ns = next_due_ns()
                if due_ns is not None and due_ns <= now_ns:
                    try:
                        on_due()
                    except BaseException as error:
                        self._on_failure(error)

    def run_until_idle(self) -> None:
        """Serve what ROS has waiting, and the events that follow from it."""
        is_idle = False

        def look() -> None:
            nonlocal is_idle
            if self._events or not self.has_taken_in:
                self.post_loop_back(look)
            else:
                is_idle = True
                self._waker.wake(None)

        self.post_loop_back(look)
        while not is_idle:
            self._executor.spin_until_future_complete(self._waker, _LONG_S)

    def run_for(self, seconds: float) -> None:
        """Serve events for a while, for instance to let the last ones out, stopped or not."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_until_future_complete(self._waker, left_s)

    def take_in(self) -> None:
        """After :meth:`run`: handle what had arrived by then, so that it is counted."""
        for _ in range(len(self._events)):
            self.guard(self._events.popleft()[0])
        self._executor.create_task(self._wake)
        self._executor.spin_until_future_complete(self._waker, _TAKE_IN_S)

    def stop(self) -> None:
        self._is_stopping = True
        self._waker.wake(None)
        # The executor gets hold of the waker only when it spins for the first time; a stop a moment
        # before that is heard by this.
        self._executor.create_task(self._wake)

    def close(self) -> None:
        """Give up the executor."""
        self._executor.shutdown(0)
        # It is of C++, and keeps callbacks, and so the loop, from being collected as garbage.
        del self._executor

    def _wake(self) -> None:
        self._waker.wake(None)

    def _end_older_events(self) -> None:
        """All that waited when a timer was overdue has been handled: now it is the timer's turn."""
        self._has_older_events = False
        self._waker.wake(None)

    def _post_turn(self) -> None:
        self._has_posted_turn = True
        self._executor.create_task(self._turn)

    def _run_turn(self) -> None:
        self._has_posted_turn = False
        if self._is_turn_stale:
            self._is_turn_stale = False
            self._post_turn()
            return
        self.has_taken_in = True
        self.turns += 1
        events = self._events
        begin_ns = since_ns = now_ns = time.monotonic_ns()
        if begin_ns - self._checked_ns > _CHECK_NS:
            busy_ns = time.thread_time_ns()
            if busy_ns - self._busy_ns > _MOST_BUSY * (begin_ns - self._checked_ns):
                time.sleep(_GAP_S)
            self._checked_ns, self._busy_ns = begin_ns, busy_ns
        length_ns = _TURN_NS
        is_first = True
        while events and not self._is_stopping:
            event, is_loop_back = events[0]
            if is_loop_back and not is_first:
                break
            is_first = False
            events.popleft()
            try:
                event()
            except BaseException as error:
                self._on_failure(error)
            since_ns, now_ns = now_ns, time.monotonic_ns()
            if not self.has_taken_in:
                break
            if now_ns - begin_ns > length_ns:
                if not self._timers:
                    length_ns = max(length_ns, min(_LONGEST_TURN_NS, _EVENTS * (now_ns - since_ns)))
                if now_ns - begin_ns > length_ns:
                    break
        # What a tick sends after a long hook is newer than what waits for the next one.
        if self._has_older_events and now_ns - since_ns > _TURN_NS:
            events.remove((self._end_older_events, False))
            self._has_older_events = False
        # Turns that do nothing any more would keep the executor from ending.
        if events and not self._has_posted_turn and not self._is_stopping:
            self._post_turn()
        if self._timers:
            self._check_timers()

    def _check_timers(self) -> None:
        """Leave the executor if a timer is due, or due at another time than was planned for."""
        if self._has_older_events:
            return
        next_ns = self._next_due_ns()
        is_due = next_ns is not None and next_ns <= time.monotonic_ns()
        if is_due or next_ns != self._planned_ns:
            self._waker.wake(None)

    def _next_due_ns(self) -> int | None:
        dues = [due for next_due_ns, _ in self._timers if (due := next_due_ns()) is not None]
        return min(dues, default=None)


def _call_back(timer: Timer) -> None:
    """Call back a timer, unless a callback before this one has cancelled or destroyed it."""
    with contextlib.suppress(InvalidHandle):
        if not timer.is_canceled():
            timer.callback()


# ---------------------------------------------------------------------- executors


class Waker(Protocol):
    """Ends a spin; looks like a future, with which the executor registers how to wake it."""

    def add_done_callback(self, callback: Callable[[Any], None]) -> None: ...
    def remove_done_callback(self, callback: Callable[[Any], None]) -> None: ...


class Executor(Protocol):
    """The part of an rclpy executor that the loop needs."""

    def add_node(self, node: RosNode) -> object: ...

    def create_task(self, callback: Callable[..., None], *arguments: Any) -> object:
        """Call back in :meth:`spin_until_future_complete`, after what waits already. Any thread."""

    def spin_until_future_complete(self, future: Waker, timeout_sec: float) -> None:
        """Serve events until the time is over, or the waker calls what was registered with it."""

    def shutdown(self, timeout_sec: float) -> object: ...


def make_executor(context: Context, on_failure: OnFailure) -> Executor:
    """The executor that was asked for, or the best that works; a fallback is logged.

    Args:
        on_failure: is given what a task has raised.

    Raises:
        EnvironmentFault: if the environment variable names none.
    """
    wanted = os.environ.get(EXECUTOR_VARIABLE, "")
    if wanted not in ("", "events", "wait_set"):
        raise EnvironmentFault(
            f"{EXECUTOR_VARIABLE} is '{wanted}', but must be 'events' or 'wait_set'"
        )
    if wanted == "wait_set":
        return WaitSetExecutor(context)
    try:
        from rclpy.experimental.events_executor import EventsExecutor  # may have gone

        with own_tasks(on_failure):
            executor: Executor = EventsExecutor(context=context)
        for name in ("add_node", "create_task", "spin_until_future_complete", "shutdown"):
            getattr(executor, name)
        return executor
    except (ImportError, AttributeError, TypeError, RuntimeError) as error:
        get_logger("neuros").warning(
            f"rclpy's EventsExecutor cannot be used here ({error}): falling back to a wait set,"
            " with which packets take longer"
        )
        return WaitSetExecutor(context)


class WaitSetExecutor:
    """Serves in turns: all that ROS has waiting, then the tasks that waited when the turn began."""

    def __init__(self, context: Context) -> None:
        self._ros = SingleThreadedExecutor(context=context)
        self._tasks: deque[Callable[[], None]] = deque()
        self._is_woken = False
        # Attributes: given another condition, rclpy begins anew, without coroutines that wait.
        self._has_other_work = lambda: self._is_woken or bool(self._tasks)
        self._has_no_other_work = lambda: False

    def add_node(self, node: RosNode) -> None:
        self._ros.add_node(node)

    def create_task(self, callback: Callable[..., None], *arguments: Any) -> None:
        self._tasks.append(partial(callback, *arguments))
        self._ros.wake()

    def spin_until_future_complete(self, future: Waker, timeout_sec: float) -> None:
        """Serve events until the time is over, or the waker says so (also since the last spin)."""
        future.add_done_callback(self._wake)
        deadline_s = time.monotonic() + timeout_sec
        try:
            while not self._is_woken:
                task_count = len(self._tasks)
                left_s = deadline_s - time.monotonic()
                if self._run_one_of_ros(0.0 if task_count else max(left_s, 0.0)):
                    self._run_what_ros_has()
                for _ in range(task_count):
                    self._tasks.popleft()()
                if left_s <= 0:
                    break
        finally:
            self._is_woken = False
            future.remove_done_callback(self._wake)

    def shutdown(self, timeout_sec: float) -> None:
        self._ros.shutdown(timeout_sec)

    def _wake(self, _: Any) -> None:
        self._is_woken = True
        self._ros.wake()

    def _run_what_ros_has(self) -> None:
        """Run what waits in ROS, and no more, so that tasks get their turn."""
        most_that_waits = sum(
            sum(each.qos_profile.depth or _SERVICE_DEPTH for each in node.subscriptions)
            + len([*node.timers])
            + _SERVICE_DEPTH * sum(len([*e]) for e in (node.services, node.clients, node.waitables))
            for node in self._ros.get_nodes()
        )
        left, has_run = most_that_waits, True
        while not self._is_woken and left > 0:
            had_run, has_run = has_run, self._run_one_of_ros(0.0)
            # A wait that a callback ended says "timeout" once, even if more has come meanwhile.
            if not (has_run or had_run):
                return
            left -= has_run

    def _run_one_of_ros(self, wait_s: float) -> bool:
        """Run one callback; returns False if there was none, or a task or a waker came first."""
        condition = self._has_other_work if wait_s else self._has_no_other_work
        try:
            task, _, _ = self._ros.wait_for_ready_callbacks(timeout_sec=wait_s, condition=condition)
        except (TimeoutException, ConditionReachedException):
            return False
        task()
        if task.exception() is not None:
            raise task.exception()
        return True
