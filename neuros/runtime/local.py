"""The local runtime: nodes in the thread that calls, without ROS until something asks for it.

Sessions and :class:`neuros.testing.PluginHarness` run nodes on it. Packets and acknowledgements are
events of one queue. A ROS context is created for the first external topic, for topics that ROS
tools are to see, and for a plugin that uses its ROS node. From then on, the loop serves ROS, too,
after the events that wait.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from neuros.ports import Inbox, Transport, Voice
from neuros.project.model import Connection, NodeFile, Port, Value
from neuros.project.names import SESSION
from neuros.transport.memory import GraphBridge, MemoryHub, MemoryTransport
from neuros.transport.messages import RosPackets

if TYPE_CHECKING:
    from neuros.transport.lean_node import LeanNode
    from neuros.transport.ros_loop import RosLoop

Event = Callable[[], None]

_SLICE_S = 0.005
"""How long ROS may keep events of threads waiting, and they ROS, while a run is idle."""
_NOTHING: Mapping[str, Value] = MappingProxyType({})


class LocalLoop:
    """Handles events in the order of posting (:class:`neuros.ports.EventLoop`).

    All packets go through one queue, so a loop-back arrives after all waiting events without a
    queue of its own.

    Args:
        clock: monotonic clock in nanoseconds.

    Attributes:
        has_taken_in: always true, since nothing arrives but by events.
        post: handle an event after all waiting events.
        ros: served after the events that wait, once there is ROS.
        interruption: raised before the next event; any thread may set it.
    """

    has_taken_in = True

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._events: deque[Event] = deque()
        self.post = self.post_loop_back = self._events.append
        self._from_threads: deque[Event] = deque()
        self._has_arrived = threading.Event()
        self._timers: list[tuple[Callable[[], int | None], Event]] = []
        self._is_stopping = False
        self.ros: RosLoop | None = None
        self.interruption: BaseException | None = None

    @property
    def has_waiting_events(self) -> bool:
        return bool(self._events)

    def post_from_thread(self, event: Event) -> None:
        self._from_threads.append(event)
        self._has_arrived.set()

    def note_execution(self) -> None:
        """Nothing arrives during an execution."""

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        self._timers.append((next_due_ns, on_due))

    @property
    def next_due_ns(self) -> int | None:
        """The time of the next timer, or ``None``."""
        dues = [due for next_due_ns, _ in self._timers if (due := next_due_ns()) is not None]
        return min(dues, default=None)

    def run_due_timers(self) -> None:
        """Call the timers that are due."""
        now_ns = self._clock()
        for next_due_ns, on_due in self._timers:
            due_ns = next_due_ns()
            if due_ns is not None and due_ns <= now_ns:
                on_due()

    def step(self) -> bool:
        """Handle the oldest event; returns whether there was one."""
        while self._from_threads:
            self._events.append(self._from_threads.popleft())
        if self._is_stopping or not self._events:
            return False
        self._events.popleft()()
        return True

    def run(self) -> None:
        """Handle events until none is left, or until :meth:`stop`."""
        while self.step():
            pass

    def run_until_idle(self) -> None:
        """Handle events, those of ROS included, until none waits.

        Raises:
            BaseException: the :attr:`interruption`; the events that wait are kept.
        """
        events, from_threads = self._events, self._from_threads
        while not self._is_stopping:
            if from_threads:
                events.append(from_threads.popleft())
            elif not events:
                if self.ros is None:
                    return
                self.ros.run_until_idle()
                if not (events or from_threads):
                    return
            if self.interruption is not None:
                self._raise_interruption()
            if events:
                events.popleft()()

    def run_for(self, seconds: float) -> None:
        """Handle events and timers for a time on the wall clock, or until :meth:`stop`.

        Raises:
            BaseException: the :attr:`interruption`; the events that wait are kept.
        """
        end_ns = self._clock() + round(seconds * 1e9)
        while not self._is_stopping and self._clock() < end_ns:
            if self.interruption is not None:
                self._raise_interruption()
            self._has_arrived.clear()
            has_run = self.step()
            self.run_due_timers()
            if not has_run and not self._events and not self._from_threads:
                self._wait(min(self.next_due_ns or end_ns, end_ns))

    def stop(self) -> None:
        """Handle no further event. Any thread."""
        self._is_stopping = True
        self._has_arrived.set()

    def _wait(self, until_ns: int) -> None:
        left_s = max(0.0, (until_ns - self._clock()) / 1e9)
        if self.ros is None:
            self._has_arrived.wait(left_s)
        else:
            self.ros.run_for(min(left_s, _SLICE_S))

    def _raise_interruption(self) -> None:
        interruption, self.interruption = self.interruption, None
        assert interruption is not None
        raise interruption


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

    ``once``, ``skip_first`` and ``throttle_duration_sec`` are accepted and have no effect.

    Args:
        write: is given the name of the logger, and each record.
    """

    def __init__(self, name: str, write: Callable[[str, Record], object]) -> None:
        self.name = name
        self._write = write

    def get_child(self, name: str) -> LocalLogger:
        """A child logger, whose records go to the same place."""
        return LocalLogger(f"{self.name}.{name}", self._write)

    def debug(self, message: str, **_: Any) -> bool:
        return self._log("DEBUG", message)

    def info(self, message: str, **_: Any) -> bool:
        return self._log("INFO", message)

    def warning(self, message: str, **_: Any) -> bool:
        return self._log("WARN", message)

    warn = warning

    def error(self, message: str, **_: Any) -> bool:
        return self._log("ERROR", message)

    def fatal(self, message: str, **_: Any) -> bool:
        return self._log("FATAL", message)

    def _log(self, severity: str, message: str) -> bool:
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
        logger: LocalLogger,
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

    def get_logger(self) -> LocalLogger:
        """The logger of the node, which is not that of ROS."""
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

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):  # copy and pickle look for such attributes
            raise AttributeError(attribute)
        if self._real is None:
            self._real = self._make(attribute)
            for name in self._parameters.keys() - self._given:
                self._real.declare_parameter(name, self._parameters[name])
        return getattr(self._real, attribute)


class _NoTopics:
    """A node without external topics (:class:`neuros.transport.memory.GraphBridge`)."""

    heard: tuple[Connection, ...] = ()

    def open(self, inbox: Inbox) -> None: ...
    def send_external(self, port: Port, packet: Any) -> None: ...
    def show(self, connections: Sequence[Connection], packet: Any) -> None: ...
    def close(self) -> None: ...


class WithoutPeers:
    """The part of a middleware that nodes without peers do not need."""

    def join_peers(
        self,
        names: Sequence[str],
        elsewhere: Sequence[str],
        heard: Callable[[str, str | None], None],
    ) -> Voice:
        """There are no peers. Raises ``NotImplementedError``."""
        raise NotImplementedError("these nodes have no peers")

    def mark_own_entities(
        self, file: NodeFile, enter: Event, fail: Callable[[Any, BaseException], None]
    ) -> None:
        """Nothing of it is served."""

    def has_foreign_entities(self, file: NodeFile) -> bool:
        """Nothing can call back."""
        return False

    def take_in(self) -> None:
        """Nothing arrives by itself."""

    def flush(self) -> None:
        """Nothing is sent to anybody."""


class LocalMiddleware(WithoutPeers):
    """Joins nodes in one thread (:class:`neuros.ports.Middleware`).

    Args:
        write: is given each record of a log, after the name of its node.
        on_failure: is called with the errors of callbacks of ROS.
        exposes: whether ROS tools see the topics of the connections.
        digest: makes a number of a packet, where digests are kept.
    """

    def __init__(
        self,
        loop: LocalLoop,
        write: Callable[[str, Record], object],
        on_failure: Callable[[BaseException], None],
        *,
        exposes: bool = False,
        digest: Callable[[Any], int | None] | None = None,
    ) -> None:
        self.loop = loop
        self.packets = RosPackets()
        self.hub = MemoryHub(loop, self.packets.copier)
        self._write = write
        self._on_failure = on_failure
        self._exposes = exposes
        self._digest = digest
        self._ros: _Ros | None = None
        self._ros_nodes: dict[str, LocalRosNode] = {}
        self._marks: dict[str, tuple[Event, Callable[[Any, BaseException], None]]] = {}

    def transport(self, file: NodeFile) -> Transport:
        self._ros_nodes[file.node.name] = self.local_ros_node(
            file, LocalLogger(file.node.name, self._write)
        )
        return MemoryTransport(file, self.hub, self.bridge(file), self._digest)

    def local_ros_node(self, file: NodeFile, logger: LocalLogger) -> LocalRosNode:
        """What a plugin gets as its ROS node."""
        node = file.node
        return LocalRosNode(node.name, logger, node.parameters, lambda _: self._ros_node(file))

    def bridge(self, file: NodeFile) -> GraphBridge:
        """The external topics of a node, and its place on the ROS graph."""
        topics = [p.external_topic for p in (*file.node.inputs, *file.node.outputs)]
        if not self._exposes and all(t is None or t.startswith(SESSION) for t in topics):
            return _NoTopics()
        from neuros.transport.ros_graph import RosGraphBridge

        ros_node = self._ros_node(file)
        assert self._ros is not None
        return RosGraphBridge(file, ros_node, self._ros.loop)

    def ros_node(self, file: NodeFile) -> Any:
        return self._ros_nodes[file.node.name]

    def mark_own_entities(
        self, file: NodeFile, enter: Event, fail: Callable[[Any, BaseException], None]
    ) -> None:
        self._marks[file.node.name] = enter, fail
        if self._ros is not None and file.node.name in self._ros.nodes:
            self._ros.mark(file, enter, fail)

    def has_foreign_entities(self, file: NodeFile) -> bool:
        return self._ros is not None and self._ros.has_foreign_entities(file)

    def close(self) -> None:
        """Give up ROS, if it was used."""
        if self._ros is not None:
            self._ros.close()
            self._ros = self.loop.ros = None

    def _ros_node(self, file: NodeFile) -> LeanNode:
        """The real ROS node of a node, made when it is asked for first."""
        if self._ros is None:
            self._ros = _Ros(self._on_failure)
            self.loop.ros = self._ros.loop
        if file.node.name not in self._ros.nodes:
            self._ros.add(file)
            if file.node.name in self._marks:
                self._ros.mark(file, *self._marks[file.node.name])
        return self._ros.nodes[file.node.name]


class _Ros:
    """ROS for local nodes: its context, its loop and the real ROS nodes.

    Attributes:
        nodes: by name.
    """

    def __init__(self, on_failure: Callable[[BaseException], None]) -> None:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from neuros.transport.dds_profile import RANGE_VARIABLE, dds_environment
        from neuros.transport.rclpy_patches import do_without_code_generator
        from neuros.transport.ros_loop import RosLoop

        do_without_code_generator()
        os.environ.setdefault(RANGE_VARIABLE, "LOCALHOST")
        os.environ.update(dds_environment(os.environ))
        self._context = rclpy.Context()
        rclpy.init(
            args=["--ros-args", "--disable-external-lib-logs"],
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.loop = RosLoop(self._context, on_failure)
        self.nodes: dict[str, LeanNode] = {}
        self._own: dict[str, set[int]] = {}
        self._callbacks: list[Any] = []

    def add(self, file: NodeFile) -> None:
        from neuros.transport.lean_node import lean_node

        self.nodes[file.node.name] = ros_node = lean_node(file, self._context)
        self.loop.add_node(ros_node)

    def mark(
        self, file: NodeFile, enter: Event, fail: Callable[[Any, BaseException], None]
    ) -> None:
        from neuros.transport.lean_node import PluginCallbacks, entities

        ros_node = self.nodes[file.node.name]
        self._own[file.node.name] = entities(ros_node)
        self._callbacks.append(PluginCallbacks(ros_node, self.loop, enter, fail))

    def has_foreign_entities(self, file: NodeFile) -> bool:
        from neuros.transport.lean_node import entities

        ros_node = self.nodes.get(file.node.name)
        if ros_node is None:
            return False
        return not entities(ros_node) <= self._own.get(file.node.name, set())

    def close(self) -> None:
        from neuros.transport.lean_node import give_up

        for callbacks in self._callbacks:
            callbacks.close()
        self.loop.close()
        give_up(self._context, self.nodes.values())
