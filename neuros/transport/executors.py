"""The two executors of rclpy that can serve a :class:`~neuros.transport.ros_loop.RosLoop`.

``events``, the default, is rclpy's ``EventsExecutor``, one queue in C++. It is in rclpy's
*experimental* package: should a release move or change it, the loop falls back to ``wait_set``, on
the public parts of ``SingleThreadedExecutor``. That one builds a new wait set for every callback: a
round trip takes two to three times as long, in an equal order of events. The environment variable
``NEUROS_EXECUTOR`` chooses.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from rclpy.context import Context
from rclpy.executors import ConditionReachedException, SingleThreadedExecutor, TimeoutException
from rclpy.logging import get_logger
from rclpy.node import Node as RosNode

from neuros.errors import EnvironmentFault
from neuros.transport.rclpy_patches import OnFailure, own_tasks

EXECUTOR_VARIABLE = "NEUROS_EXECUTOR"
"""``events`` or ``wait_set``; unset, the first that works."""

_SERVICE_DEPTH = 10


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
        """Serve what is on a ROS node."""
        self._ros.add_node(node)

    def create_task(self, callback: Callable[..., None], *arguments: Any) -> None:
        """Call back after what waits already. Any thread."""
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
        """Give up the wait set."""
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
