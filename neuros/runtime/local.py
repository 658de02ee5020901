"""The local runtime: nodes in the thread that calls, without ROS until something asks for it.

Sessions and :class:`neuros.testing.PluginHarness` run nodes on it, and the process of the back end
``in-process``. Packets and acknowledgements are events of one queue. A ROS context is created for
the first external topic, for topics that ROS tools are to see, and for a plugin that uses its ROS
node. From then on, the loop serves ROS, too.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

from neuros.ports import Inbox, Logger, NodeEvents, StatePublisher, Transport
from neuros.project.model import Connection, NodeFile, Port, Value
from neuros.project.names import SESSION
from neuros.transport.imports_when_used import imports_when_used
from neuros.transport.memory import GraphBridge, MemoryHub, MemoryTransport
from neuros.transport.messages import RosPackets

if TYPE_CHECKING:
    from neuros.transport.lean_node import Fail, LeanNode
    from neuros.transport.ros_loop import RosLoop
    from neuros.transport.ros_process import RosProcess

Event = Callable[[], None]

_SLICE_S = 0.005
"""How long ROS may keep events of threads waiting, and they ROS, while a run is idle."""
_NOTHING: Mapping[str, Value] = MappingProxyType({})


class LocalLoop:
    """Handles events in the order of posting (:class:`neuros.ports.EventLoop`).

    All packets go through one queue, so a loop-back arrives after all waiting events without a
    queue of its own. A session serves ROS itself, between rounds; :meth:`run` leaves all events to
    the loop of ROS, once there is one.

    Args:
        clock: monotonic clock in nanoseconds.

    Attributes:
        clock: that clock.
        waits_for: nothing, ever.
        post: handle an event after all waiting events.
        ros: the loop of ROS, once there is one; see :meth:`serve`.
        interruption: raised before the next event; see :meth:`interrupt`.
    """

    waits_for = ""

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.clock = clock
        self._events: deque[Event] = deque()
        self.post: Callable[[Event], None] = self._events.append
        self.post_loop_back = self.post
        # Also signal handlers post there, which the lock of threading.Event would hang.
        self._from_threads: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._timers: list[tuple[Callable[[], int | None], Event]] = []
        self._is_stopping = False
        self._end_ns = 0
        self.ros: RosLoop | None = None
        self._leader: RosLoop | None = None  # handles all events, from some time on
        self.interruption: BaseException | None = None

    @property
    def has_taken_in(self) -> bool:
        """Whether all arrivals have been handled: only those of ROS come by themselves."""
        return self._leader is None or self._leader.has_taken_in

    @property
    def has_waiting_events(self) -> bool:
        return bool(self._events) if self._leader is None else self._leader.has_waiting_events

    def serve(self, ros: RosLoop) -> None:
        """Serve ROS from now on. Any thread."""
        self.ros = ros
        self.post_from_thread(_nothing)

    def post_from_thread(self, event: Event) -> None:
        self._from_threads.put(event)
        if self._leader is not None:
            self._leader.post_from_thread(self._post_arrived)

    def note_execution(self) -> None:
        if self._leader is not None:
            self._leader.note_execution()

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        self._timers.append((next_due_ns, on_due))
        if self._leader is not None:
            self._leader.add_timer(next_due_ns, on_due)

    @property
    def next_due_ns(self) -> int | None:
        """The time of the next timer, or ``None``."""
        dues = [due for next_due_ns, _ in self._timers if (due := next_due_ns()) is not None]
        return min(dues, default=None)

    def run_due_timers(self) -> None:
        now_ns = self.clock()
        for next_due_ns, on_due in self._timers:
            due_ns = next_due_ns()
            if due_ns is not None and due_ns <= now_ns:
                on_due()

    def step(self) -> bool:
        """Handle the oldest event; returns whether there was one."""
        while not self._from_threads.empty():
            self._events.append(self._from_threads.get())
        if self._is_stopping or not self._events:
            return False
        self._events.popleft()()
        return True

    def run_until_idle(self) -> None:
        """Handle events, those of ROS included, until none waits.

        Raises:
            BaseException: the :attr:`interruption`; the events that wait are kept.
        """
        events, from_threads = self._events, self._from_threads
        while not self._is_stopping:
            if not from_threads.empty():  # an interruption comes with an event, too
                if self.interruption is not None:
                    self._raise_interruption()
                events.append(from_threads.get())
            elif events:
                events.popleft()()
            elif self.ros is None:
                return
            else:
                self.ros.run_until_idle()
                if not events and from_threads.empty():
                    return

    def run_for(self, seconds: float) -> None:
        """Handle events, timers and ROS for a time on the wall clock, or until :meth:`end_run`.

        Raises:
            BaseException: the :attr:`interruption`; the events that wait are kept.
        """
        self._end_ns = self.clock() + round(seconds * 1e9)
        ros_due_ns = 0
        while (now_ns := self.clock()) < self._end_ns:
            if self.interruption is not None:
                self._raise_interruption()
            if self.ros is not None and now_ns >= ros_due_ns:
                ros_due_ns = now_ns + round(_SLICE_S * 1e9)
                self.ros.run_until_idle()
            self._go_on(self._end_ns)

    def end_run(self) -> None:
        """End :meth:`run_for` after the current event."""
        self._end_ns = 0

    def run(self) -> None:
        """Handle events and timers until :meth:`stop`; with ROS, in one queue with its events."""
        while self.ros is None and not self._is_stopping:
            self._go_on(None)
        if self.ros is None:
            return
        ros = self._leader = self.ros
        self.post, self.post_loop_back = ros.post, ros.post_loop_back
        for timer in self._timers:
            ros.add_timer(*timer)
        for event in self._events:
            ros.post(event)
        self._events.clear()
        self._post_arrived()
        if not self._is_stopping:
            ros.run()

    def take_in(self) -> None:
        """After :meth:`run`: handle what had arrived by then, so that it is counted."""
        for _ in range(len(self._events)):
            self._events.popleft()()

    def stop(self) -> None:
        self._is_stopping = True
        self.post_from_thread(_nothing)
        if self.ros is not None:
            self.ros.stop()

    def interrupt(self, error: BaseException) -> None:
        """Raise an error before the next event. Any thread, and a signal handler."""
        self.interruption = error
        self._from_threads.put(_nothing)

    def wait(self, seconds: float | None) -> None:
        """Wait for an event of another thread, or for ROS; not longer than this."""
        if self.ros is not None:
            self.ros.run_for(_SLICE_S if seconds is None else min(seconds, _SLICE_S))
            return
        if not self._is_stopping:  # else what tells of that may have been taken
            with contextlib.suppress(queue.Empty):
                self._events.append(self._from_threads.get(timeout=seconds))

    def _go_on(self, end_ns: int | None) -> None:
        """Handle the oldest event, or wait for one; then the timers that are due."""
        if not self.step():
            times = [ns for ns in (self.next_due_ns, end_ns) if ns is not None]
            left_s = max(0.0, (min(times) - self.clock()) / 1e9) if times else None
            self.wait(left_s)
        if self._timers:
            self.run_due_timers()

    def _post_arrived(self) -> None:
        while not self._from_threads.empty():
            self.post(self._from_threads.get())

    def _raise_interruption(self) -> None:
        interruption, self.interruption = self.interruption, None
        assert interruption is not None
        raise interruption


def _nothing() -> None:
    """An event that only wakes the loop."""


_LEVELS = {
    "DEBUG": logging.DEBUG,
    "INFO": logging.INFO,
    "WARN": logging.WARNING,
    "ERROR": logging.ERROR,
    "FATAL": logging.CRITICAL,
}


class Record(NamedTuple):
    """A line of a node's log; ``severity`` is DEBUG, INFO, WARN, ERROR or FATAL."""

    severity: str
    text: str


def log_in_python(name: str, record: Record) -> None:
    """Pass a record on to Python's ``logging``, to the logger ``neuros.<name>``."""
    logging.getLogger(f"neuros.{name}").log(_LEVELS[record.severity], "%s", record.text)


class LocalLogger:
    """The logger of a node without ROS; its methods are those of rclpy's logger.

    Args:
        write: is given the name of the logger, and each record.
        level: the lowest severity that is written, as a number of ``logging`` or of rclpy.
    """

    def __init__(
        self, name: str, write: Callable[[str, Record], object], level: int = logging.DEBUG
    ) -> None:
        self.name = name
        self._write = write
        self._level = level
        self._calls: dict[tuple[str, int], tuple[int, float]] = {}  # number, last written (s)

    def get_child(self, name: str) -> LocalLogger:
        """A child logger, whose records go to the same place."""
        return LocalLogger(f"{self.name}.{name}", self._write, self._level)

    def set_level(self, level: int) -> None:
        self._level = int(level)

    def get_effective_level(self) -> int:
        return self._level

    def is_enabled_for(self, severity: int) -> bool:
        return int(severity) >= self._level

    def debug(self, message: str, **options: Any) -> bool:
        return self._log("DEBUG", message, **options)

    def info(self, message: str, **options: Any) -> bool:
        return self._log("INFO", message, **options)

    def warning(self, message: str, **options: Any) -> bool:
        return self._log("WARN", message, **options)

    warn = warning

    def error(self, message: str, **options: Any) -> bool:
        return self._log("ERROR", message, **options)

    def fatal(self, message: str, **options: Any) -> bool:
        return self._log("FATAL", message, **options)

    def _log(
        self,
        severity: str,
        message: str,
        *,
        once: bool = False,
        skip_first: bool = False,
        throttle_duration_sec: float = 0.0,
        **_: Any,
    ) -> bool:
        if not self.is_enabled_for(_LEVELS[severity]):
            return False
        if once or skip_first or throttle_duration_sec:
            caller = sys._getframe(2)
            place, now_s = (caller.f_code.co_filename, caller.f_lineno), time.monotonic()
            number, last_s = self._calls.get(place, (0, -math.inf))
            self._calls[place] = number + 1, last_s
            is_early = now_s - last_s < (math.inf if once else throttle_duration_sec)
            if is_early or (skip_first and number == 0):
                return False
            self._calls[place] = number + 1, now_s
        self._write(self.name, Record(severity, str(message)))
        return True


class LocalRosNode:
    """The result of ``node.get_ros_node()``: name, logger and parameters, without ROS.

    Everything else is that of the real ``rclpy.node.Node``, which is made when it is asked for.

    Args:
        make: makes the real node; it is given the attribute that asks for it.
    """

    def __init__(
        self,
        name: str,
        logger: Logger,
        parameters: Mapping[str, Value],
        make: Callable[[str], Any],
    ) -> None:
        self._name = name
        self._logger = logger
        self._parameters: dict[str, Any] = dict(parameters)
        self._given = {*parameters}
        self._make = make
        self._real: Any = None

    def get_name(self) -> str:
        return self._name

    def get_logger(self) -> Logger:
        return self._logger

    def has_parameter(self, name: str) -> bool:
        return bool(self._real.has_parameter(name)) if self._real else name in self._parameters

    def get_parameter(self, name: str) -> Any:
        """A parameter that the project, or the plugin, has declared."""
        from neuros.transport.lean_node import Parameter, ParameterNotDeclaredException

        if self._real:
            return self._real.get_parameter(name)
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        return Parameter(name, value=self._parameters[name])

    def declare_parameter(self, name: str, value: Any = None, *rest: Any, **keywords: Any) -> Any:
        """Declare a parameter as in rclpy; a value of the project wins."""
        if self._real:
            return self._real.declare_parameter(name, value, *rest, **keywords)
        if name not in self._given:
            self._parameters[name] = value
        return self.get_parameter(name)

    def set_parameters(self, parameters: Sequence[Any]) -> Sequence[Any]:
        if not self._real and all(each.name in self._parameters for each in parameters):
            self._parameters |= {each.name: each.value for each in parameters}
            return [SimpleNamespace(successful=True, reason="") for _ in parameters]
        results: Sequence[Any] = self.__getattr__("set_parameters")(parameters)
        return results

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):  # copy and pickle look for such attributes
            raise AttributeError(attribute)
        if self._real is None:
            self._real = self._make(attribute)
            for name in self._parameters.keys() - self._given:
                self._real.declare_parameter(name, self._parameters[name])
        return getattr(self._real, attribute)


class NoTopics:
    """A node without external topics (:class:`neuros.transport.memory.GraphBridge`)."""

    heard: tuple[Connection, ...] = ()

    def open(self, inbox: Inbox) -> None: ...
    def send_external(self, port: Port, packet: Any) -> None: ...
    def show(self, connections: Sequence[Connection], packet: Any) -> None: ...
    def close(self) -> None: ...


class LocalMiddleware:
    """Joins nodes in one thread (:class:`neuros.ports.Middleware`).

    Args:
        loop: handles the events; ``None``: that of ROS, which is there from the start then.
        write: is given each record of a log, after the name of its node; ``None``: nodes log as
            ROS does.
        on_failure: is called with the errors of callbacks of ROS.
        files: all nodes, where they share a process of their own.
        exposes: whether ROS tools see the topics of the connections.
        debug: whether ROS logs DEBUG records, too.
        digest: makes a number of a packet, where digests are kept.
        digests_of: whether they are kept of a connection.
        level: of logs that are written by ``write``.
    """

    def __init__(
        self,
        loop: LocalLoop | None,
        write: Callable[[str, Record], object] | None,
        on_failure: Callable[[BaseException], None],
        *,
        files: Sequence[NodeFile] = (),
        exposes: bool = False,
        debug: bool = False,
        digest: Callable[[Any], int | None] | None = None,
        digests_of: Callable[[Connection], bool] = lambda _: True,
        level: int = logging.DEBUG,
    ) -> None:
        self._local = loop
        self._write = write
        self._on_failure = on_failure
        self._files = files
        self._exposes = exposes
        self._debug = debug
        self._digest = digest
        self._level = level
        self._digests_of = digests_of
        self._ros: RosProcess | None = None
        self._ros_nodes: dict[str, Any] = {}
        self._marks: dict[str, Callable[[RosProcess], None]] = {}
        self._transports: list[Transport] = []
        self.loop: LocalLoop | RosLoop = loop or self._with_ros().ros_loop
        self.packets = RosPackets()
        self.hub = MemoryHub(self.loop, self.packets.copier)

    def transport(self, file: NodeFile) -> Transport:
        is_local = self._local is not None
        self._ros_nodes[file.node.name] = (
            self.local_ros_node(file, self._logger(file)) if is_local else self._ros_node(file)
        )
        transport = self._memory_transport(file)
        self._transports.append(transport)
        return transport

    def _memory_transport(self, file: NodeFile) -> Transport:
        return MemoryTransport(file, self.hub, self.bridge(file), self._digest, self._digests_of)

    def loop_of(self, file: NodeFile) -> NodeEvents:
        return self.loop

    def begin_anew(
        self, files: Sequence[NodeFile], variables: Mapping[str, Mapping[str, str]]
    ) -> None:
        """Nothing: real time goes on, and is drawn from no seed."""

    def local_ros_node(self, file: NodeFile, logger: Logger) -> LocalRosNode:
        node = file.node
        return LocalRosNode(node.name, logger, node.parameters, lambda _: self._ros_node(file))

    def bridge(self, file: NodeFile) -> GraphBridge:
        """The external topics of a node, and its place on the ROS graph."""
        topics = [p.external_topic for p in (*file.node.inputs, *file.node.outputs)]
        if not self._exposes and all(t is None or t.startswith(SESSION) for t in topics):
            return NoTopics()
        from neuros.transport.ros_graph import RosGraphBridge

        shown = file if self._exposes else replace(file, connections=())
        return RosGraphBridge(shown, self._ros_node(file), self._with_ros().ros_loop)

    def ros_node(self, file: NodeFile) -> Any:
        return self._ros_nodes[file.node.name]

    def mark_own_entities(self, file: NodeFile, enter: Event, fail: Fail) -> None:
        thread = threading.get_ident()
        name = file.node.name
        self._marks[name] = lambda ros: ros.mark_own_entities(file, enter, fail, thread)
        if self._ros is not None and self._ros.has_node(file):
            self._marks[name](self._ros)

    def has_foreign_entities(self, file: NodeFile) -> bool:
        return self._ros is not None and self._ros.has_foreign_entities(file)

    def join_peers(
        self,
        names: Sequence[str],
        elsewhere: Sequence[str],
        heard: Callable[[str, str | None], None],
    ) -> StatePublisher:
        return self._with_ros().join_peers(names, elsewhere, heard)

    def take_in(self) -> None:
        """Handle what had arrived when the loop ended, but for callbacks of plugins."""
        if self._ros is not None:
            self._ros.take_in()
        if self._local is not None:
            self._local.take_in()

    def flush(self) -> None:
        for transport in self._transports:
            transport.close()
        if self._ros is not None:
            self._ros.flush()

    def close(self) -> None:
        ros, self._ros = self._ros, None
        if ros is not None:
            ros.close(may_stay=bool(self._files))
        if self._local is not None:
            self._local.ros = None

    def _logger(self, file: NodeFile) -> Logger:
        if self._write is not None:
            return LocalLogger(file.node.name, self._write, self._level)
        from rclpy.logging import LoggingSeverity, get_logger

        logger: Logger = get_logger(file.logger_name)
        if self._debug:
            logger.set_level(LoggingSeverity.DEBUG)  # type: ignore[attr-defined]
        return logger

    def _ros_node(self, file: NodeFile) -> LeanNode:
        """The real ROS node of a node, made when it is asked for first."""
        ros = self._with_ros()
        is_new = not ros.has_node(file)
        ros_node = ros.ros_node(file)
        if is_new and file.node.name in self._marks:
            self._marks[file.node.name](ros)
        return ros_node

    def _with_ros(self) -> RosProcess:
        """The part of ROS in this process, made when it is asked for first."""
        if self._ros is None:
            from neuros.transport.dds_profile import RANGE_VARIABLE

            with imports_when_used():
                from neuros.transport.ros_process import RosProcess

            os.environ.setdefault(RANGE_VARIABLE, "LOCALHOST")
            self._ros = RosProcess(self._files, self._on_failure, debug=self._debug)
            if self._local is not None:
                self._local.serve(self._ros.ros_loop)
        return self._ros
