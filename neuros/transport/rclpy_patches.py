"""Changes to rclpy and to Fast DDS, each with its reason, and when it can go.

``tests/integration/test_rclpy_patches.py`` fails as soon as a release does without one of them.
"""

from __future__ import annotations

import ctypes
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import rclpy.task

if TYPE_CHECKING:
    from rclpy.node import Node as RosNode

OnFailure: TypeAlias = Callable[[BaseException], None]

# ---------------------------------------------------------------------- tasks
#
# Where a task fails, the EventsExecutor reads the logger of the first node from a set, and ends the
# process by SIGSEGV: https://github.com/ros2/rclpy/issues/1641, corrected by its pull request 1718.


class Turn(partial[None]):
    """A callback that can stand in the queue of an executor again and again.

    ``create_task`` of rclpy makes a task for each call, an object with two locks and a weak
    reference, for 4 of the 6.5 us that a turn in the queue takes. This one takes the place of such
    a task itself, and has always been done. Where rclpy wraps it after all, that works, too.
    """

    def done(self) -> bool:
        """The queue may forget it."""
        return True

    def exception(self) -> None:
        """The callback raises none."""


class GuardedTask(rclpy.task.Task):  # type: ignore[misc]
    """A task of rclpy that fails without the executor, which would end the process by SIGSEGV.

    If it is a coroutine, it goes on as soon as the future that it waits for is done. The executor
    looks at coroutines only after callbacks of ROS, so one whose future was set by a hook or by
    another task waited for ever if nothing of ROS followed: for the result of an action, where that
    came in one go with the feedback.
    """

    on_failure: OnFailure
    _is_hidden = False
    _awaited: rclpy.task.Future | None = None

    def __call__(self) -> None:
        self._go_on()
        self._is_hidden = self._exception is not None  # whoever calls, the executor, asks next

    def _go_on(self) -> None:
        if not self._pending():
            return
        super().__call__()
        if not self._pending():
            if self._exception is not None:
                self.on_failure(self._exception)
            return
        awaited = _awaited_by(self._handler)
        if awaited is not None and awaited is not self._awaited:
            awaited.add_done_callback(self._post)
        self._awaited = awaited

    def _post(self, _: object) -> None:
        executor = self._executor()
        if executor is not None:
            executor.create_task(Turn(self._go_on))

    def __del__(self) -> None:
        if inspect.iscoroutine(handler := getattr(self, "_handler", None)):
            handler.close()  # else one that the end came before would be "never awaited"
        super().__del__()

    def exception(self) -> BaseException | None:
        """The error of the task; ``None`` for the executor, which asks first."""
        if self._is_hidden:
            self._is_hidden = False
            return None
        found: BaseException | None = super().exception()
        return found


def _awaited_by(coroutine: Any) -> rclpy.task.Future | None:
    """The future of ROS that a coroutine waits for, if it can be seen."""
    found = inner = coroutine
    while inner is not None:
        found, inner = inner, getattr(inner, "cr_await", getattr(inner, "gi_yieldfrom", None))
    if getattr(found, "gi_code", None) is not rclpy.task.Future.__await__.__code__:
        return None
    future: rclpy.task.Future = found.gi_frame.f_locals["self"]
    return future


@contextmanager
def own_tasks(on_failure: OnFailure) -> Iterator[None]:
    """Let an executor that is made now take a :class:`Turn` for a task, and guard all others.

    It looks up the class of tasks once, when it is made, and there is no other way to tell it.
    """
    task = rclpy.task.Task

    def make_task(handler: Any, *arguments: Any, **keywords: Any) -> Any:
        if type(handler) is Turn:
            return handler
        made = GuardedTask(handler, *arguments, **keywords)
        made.on_failure = on_failure
        return made

    rclpy.task.Task = make_task
    try:
        yield
    finally:
        rclpy.task.Task = task


# ---------------------------------------------------------------------- end of Fast DDS
#
# https://github.com/eProsima/Fast-DDS/issues/6513, open. When rmw_fastrtps destroys the participant
# of a context, it takes away its listener first and waits until no callback runs there. Fast DDS
# (2.14 to 2.14.6) waits until the largest time there is. Where the C++ library turns that into a
# time of another clock, as in the wheels, it overflows: the wait returns at once, again and again,
# and never lets go of the lock that the callback needs for its end. So a process that ends while
# DDS tells it that another ends, as all nodes of a project do, may hang, with a busy core and with
# Python's global lock. A finite time does not overflow, and once the listener is gone nothing waits
# for it any more.


_RMW = "librmw_fastrtps_cpp.so"
_PARTICIPANT = "_ZN16rmw_fastrtps_cpp22get_domain_participantEP10rmw_node_s"
_SET_LISTENER = (
    "_ZN8eprosima7fastdds3dds17DomainParticipant12set_listenerEPNS1_25DomainParticipantListener"
    "ENSt6chrono8durationIlSt5ratioILl1ELl1EEEE"
)
_LONGEST_S = 2
"""For a callback of discovery, which takes microseconds."""


def end_discovery(ros_node: RosNode) -> None:
    """Remove the listener of a node's participant; does nothing with another RMW."""
    try:
        rmw = ctypes.CDLL(_RMW, mode=os.RTLD_NOLOAD | os.RTLD_LAZY)
        get_rmw_node = ctypes.CDLL("librcl.so", mode=os.RTLD_NOLOAD).rcl_node_get_rmw_handle
        get_participant, set_listener = rmw[_PARTICIPANT], rmw[_SET_LISTENER]
    except (OSError, AttributeError):
        return
    for function in (get_rmw_node, get_participant):
        function.argtypes, function.restype = [ctypes.c_void_p], ctypes.c_void_p
    set_listener.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64]
    with ros_node.handle:  # it exists meanwhile
        participant = get_participant(get_rmw_node(ros_node.handle.pointer))
        if participant:
            set_listener(participant, None, _LONGEST_S)


# ---------------------------------------------------------------------- imports


def keep_to_the_end(ros_nodes: Iterable[RosNode]) -> None:
    """Let neither Python nor Fast DDS destroy anything of these nodes as the process ends."""
    for node in ros_nodes:
        for each in (node, *node.publishers, *node.subscriptions, *node.services, *node.clients):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(each.handle))
    libc = ctypes.CDLL(None)
    libc.fflush(None)
    libc.on_exit(libc._exit, None)  # as the first of all such functions: no destructor is called


def do_without_code_generator() -> None:
    """Import ``rosidl_generator_py``, which messages need, without ``generate_py`` in it.

    It goes without where that cannot be imported. A node does not need it, and what it imports in
    turn (a parser) would take a node a seventh of the time of all imports.
    """
    generator = "rosidl_generator_py.generate_py_impl"
    if generator in sys.modules:
        return
    sys.modules[generator] = None  # type: ignore[assignment]
    try:
        importlib.import_module("rosidl_generator_py")
    finally:
        del sys.modules[generator]
