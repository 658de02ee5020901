"""``PluginHarness``: one plugin on the real engine; the test plays all other nodes."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import tempfile
import weakref
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from neuros.backends.node_command import without_mark
from neuros.control import Message, Shutdown
from neuros.distribution import WORKSPACE
from neuros.engine.connection_ends import SendWindow
from neuros.engine.engine import Engine
from neuros.engine.snapshot import explain, snapshot
from neuros.errors import NeurosError, NodeError, ProjectError
from neuros.installation.progress import Progress
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces
from neuros.node.context import ContextSwitch
from neuros.node.handle import NodeHandle
from neuros.node.keeping import restore_values
from neuros.node.node import NodeRuntime
from neuros.node.plugin import no_module
from neuros.ports import Inbox, Logger
from neuros.project.in_python import Plugin, functions_of, plugin_key
from neuros.project.load import load_project
from neuros.project.message_types import in_full, normalised, with_copies, wrong_array
from neuros.project.model import Connection, Folders, Node, NodeFile, Port, Value
from neuros.project.paths import find_module, is_module_name
from neuros.project.plugin_files import file_of
from neuros.runtime.local import (
    LocalLoop,
    LocalMiddleware,
    LocalRosNode,
    Record,
    log_in_python,
)
from neuros.transport.memory import MemoryHub
from neuros.transport.messages import checked, copy_packet, make_packet

_NOTHING: Mapping[str, Value] = MappingProxyType({})


class ManualClock:
    """A monotonic clock in nanoseconds; it starts at 0."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


class StepLoop(LocalLoop):
    """The loop of the runtime, with a clock that a test advances."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__(clock)
        self._manual = clock

    def advance_to(self, time_ns: int) -> None:
        """Advance the clock, and call the timers that are due."""
        self._manual.now_ns = time_ns
        self.run_due_timers()


class RosNodeStandIn(LocalRosNode):
    """The result of ``node.get_ros_node()`` in a test: name, logger and parameters, without ROS.

    Args:
        topics: by name of the node's topics: type, number of publishers, number of subscribers.
    """

    def __init__(
        self,
        name: str,
        logger: Logger,
        parameters: Mapping[str, Value] = _NOTHING,
        topics: Mapping[str, tuple[str, int, int]] = MappingProxyType({}),
    ) -> None:
        super().__init__(name, logger, parameters, _refuse)
        self._topics = topics

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """The topics of the node's own ports."""
        return [(name, [topic[0]]) for name, topic in sorted(self._topics.items())]

    def count_publishers(self, name: str) -> int:
        """The number of publishers: the node, or the test."""
        return self._topics[name][1]

    def count_subscribers(self, name: str) -> int:
        return self._topics[name][2]


def _refuse(attribute: str) -> Any:
    raise NodeError(
        f"get_ros_node().{attribute}: there is no ROS behind a PluginHarness, only"
        " get_logger(), get_name() and parameters: test this part in a project that is launched"
    )


class Topics:
    """External topics in a test (``GraphBridge`` of a transport); published packets are kept."""

    heard: tuple[Connection, ...] = ()

    def __init__(self) -> None:
        self.inbox: Inbox | None = None
        self.published: dict[str, list[Any]] = {}

    def open(self, inbox: Inbox) -> None:
        self.inbox = inbox

    def deliver(self, port: Port, packet: Any) -> None:
        if self.inbox is not None:
            self.inbox.on_external_packet(port, packet)

    def send_external(self, port: Port, packet: Any) -> None:
        self.published.setdefault(port.name, []).append(copy_packet(packet))

    def show(self, connections: Sequence[Connection], packet: Any) -> None:
        """The test has no ROS tools that subscribe."""

    def close(self) -> None:
        """Drop further packets."""
        self.inbox = None


class Workbench(LocalMiddleware):
    """The middleware of one node under test (:class:`neuros.ports.Middleware`)."""

    def __init__(self, loop: StepLoop, topics: Topics, log: list[Record]) -> None:
        def write(name: str, record: Record) -> None:
            log.append(record)
            log_in_python(name, record)

        super().__init__(loop, write, _raise)
        self._topics = topics

    def local_ros_node(self, file: NodeFile, logger: Logger) -> LocalRosNode:
        node = file.node
        return RosNodeStandIn(node.name, logger, node.parameters, _topics_of(file))

    def bridge(self, file: NodeFile) -> Topics:
        return self._topics


def _raise(error: BaseException) -> None:
    raise error


def _topics_of(file: NodeFile) -> dict[str, tuple[str, int, int]]:
    """The topics of a node's ports, as on the ROS graph."""
    node = file.node
    found = {}
    for c in file.connections:
        is_output = c.source_node == node.name
        port = node.output(c.source_output) if is_output else node.input(c.destination_input)
        found[f"{c.topic}/data"] = (port.ros_type, 1, 1)
    for is_output, ports in ((True, node.outputs), (False, node.inputs)):
        for port in ports:
            if port.external_topic is not None:
                name = file.names.resolve(port.external_topic, node.name)
                found[name] = (port.ros_type, int(is_output), int(not is_output))
    return found


# ---------------------------------------------------------------------- wiring
#
# The surroundings of a node under test: its ports, and the neighbours it is connected to.


SENDER, RECEIVER, OBSERVER = "sender", "receiver", "observer"
_MANY = 1_000_000


def wire(text: str, discard_limit: int | None = None, queue_size: int = 1) -> Connection:
    """A connection, written ``"camera.image -> node.view"``; without limit it is best effort.

    >>> wire("camera.image -> node.view", discard_limit=0).is_reliable
    True
    """
    ends = [end.strip().split(".") for end in text.split("->")]
    if [len(end) for end in ends] != [2, 2] or not all(part for end in ends for part in end):
        raise ValueError(f"{text!r} is not a connection: write 'node.output -> node.input'")
    (source, output), (destination, input_name) = ends
    return Connection(source, output, destination, input_name, discard_limit, queue_size)


def ports(types: Mapping[str, str], copies: int | None = None) -> tuple[Port, ...]:
    """Ports from their names and message types, in either notation."""
    found = []
    for name, written in types.items():
        type_name = normalised(in_full(written))
        if type_name is None:
            text, hint = wrong_array(written) or (
                f"{written!r} is not a message type",
                "write it like 'std_msgs/msg/String'",
            )
            raise ValueError(f"'{name}': {text}{hint and f': {hint}'}")
        found.append(Port(name, with_copies(type_name, copies)))
    return tuple(found)


def with_neighbours(node: Node, connections: Sequence[Connection]) -> tuple[Connection, ...]:
    """Add a lossless connection for each port that has none: from ``sender``, to ``receiver``.

    Raises ``ValueError`` for a given connection that does not fit the node.
    """
    inputs, outputs = {p.name for p in node.inputs}, {p.name for p in node.outputs}
    for each in connections:
        if node.name not in (each.source_node, each.destination_node):
            raise ValueError(f"{each} neither begins nor ends at node '{node.name}'")
        for end, port, known, side in (
            (each.source_node, each.source_output, outputs, "output"),
            (each.destination_node, each.destination_input, inputs, "input"),
        ):
            if end == node.name and port not in known:
                raise ValueError(f"{each}: node '{node.name}' has no {side} '{port}'")
    taken = {c.destination_input for c in connections if c.destination_node == node.name}
    given = {c.source_output for c in connections if c.source_node == node.name}
    added = [
        Connection(SENDER, port.name, node.name, port.name, 0)
        for port in node.inputs
        if port.name not in taken and port.external_topic is None
    ] + [
        Connection(node.name, port.name, RECEIVER, port.name, 0)
        for port in node.outputs
        if port.name not in given and port.external_topic is None
    ]
    return numbered([*connections, *added])


def with_observer(node: Node, connections: Sequence[Connection]) -> tuple[Connection, ...]:
    """Add a best-effort receiver, which never blocks, for each output without one."""
    seen = {
        c.source_output
        for c in connections
        if c.source_node == node.name and c.destination_node != node.name
    }
    added = [
        Connection(node.name, port.name, OBSERVER, port.name, queue_size=_MANY)
        for port in node.outputs
        if port.name not in seen and port.external_topic is None
    ]
    return numbered([*connections, *added])


def numbered(connections: Sequence[Connection]) -> tuple[Connection, ...]:
    return tuple(replace(each, index=index) for index, each in enumerate(connections))


_MOST_STARTS = 10_000
"""Hook executions after which :meth:`PluginHarness.run` assumes that they never end."""


class Neighbours:
    """All nodes around the node under test (:class:`neuros.ports.Inbox` of each).

    A packet waits here until its connection lets it through. Neighbours start on received packets
    at once, and so acknowledge them, unless they are busy.
    """

    def __init__(self, file: NodeFile, hub: MemoryHub) -> None:
        name = file.node.name
        self.incoming = [c for c in file.connections if c.destination_node == name != c.source_node]
        self.outgoing = [c for c in file.connections if c.source_node == name != c.destination_node]
        self._windows = {connection: SendWindow(connection) for connection in self.incoming}
        self._waiting: dict[Connection, deque[Any]] = {c: deque() for c in self.incoming}
        self.received: dict[Connection, list[Any]] = {c: [] for c in self.outgoing}
        self._started: dict[Connection, int] = dict.fromkeys(self.outgoing, 0)
        self.busy: set[Connection] = set()
        self._hub = hub
        ends = [c.source_node for c in self.incoming] + [c.destination_node for c in self.outgoing]
        for end in dict.fromkeys(ends):
            hub.join(end, self, [c for c in self.incoming if c.source_node == end])

    def send(self, connection: Connection, packet: Any) -> None:
        """Send a packet, or keep it until its connection lets it through."""
        self._waiting[connection].append(copy_packet(packet))
        self._send_waiting(connection)

    def unsent(self, connections: Sequence[Connection]) -> int:
        """Number of packets that wait for the node to start on earlier ones."""
        return sum(len(self._waiting[connection]) for connection in connections)

    def start_on(self, connection: Connection, count: int | None) -> None:
        """Let a busy receiver start on ``count`` packets, or with ``None`` on all it has."""
        started = self._started[connection]
        arrived = len(self.received[connection])
        position = arrived if count is None else min(arrived, started + count)
        if position > started:
            self._started[connection] = position
            if connection.is_reliable:
                node = self._hub.ends[connection.source_node].inbox
                self._hub.loop.post(partial(node.on_acknowledgement, connection, position))

    # ------------------------------------------------------------------ inbox

    def on_packet(self, connection: Connection, packet: Any) -> None:
        self.received[connection].append(packet)
        if connection not in self.busy:
            self.start_on(connection, None)

    def on_external_packet(self, port: Port, packet: Any) -> None:
        """Neighbours have no external topics."""

    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None:
        """The node has started on packets: more may be sent."""
        self._windows[connection].credit(position, 0)
        self._send_waiting(connection)

    def on_registered(self, connection: Connection) -> None:
        """The node is always there."""

    def _send_waiting(self, connection: Connection) -> None:
        window, waiting = self._windows[connection], self._waiting[connection]
        while waiting and not window.is_blocked:
            window.spend(0)
            node = self._hub.ends[connection.destination_node].inbox
            self._hub.loop.post(partial(node.on_packet, connection, waiting.popleft()))


class PluginHarness:
    """Tests a plugin without ROS processes and without a launcher.

    The engine is the one that runs the plugin in a project, and so are the message classes; time
    and all events come from the test, so that a test gives the same result every time. Given a
    plugin ``doubler.py``::

        from neuros.hooks import neuros_function

        @neuros_function(inputs="number", outputs="double")
        def double(node, number):
            result = node.make_packet("double")
            result.data = 2 * number.data
            node.get_logger().info(f"2 x {number.data}")
            return result

    this tests it:

    >>> from std_msgs.msg import Int32
    >>> from neuros.testing import PluginHarness
    >>> harness = PluginHarness(
    ...     "doubler.py",
    ...     inputs={"number": "std_msgs/msg/Int32"},
    ...     outputs={"double": "std_msgs/msg/Int32"},
    ... )
    >>> harness.send("number", Int32(data=21))
    >>> harness.run()
    1
    >>> harness.received("double")
    [std_msgs.msg.Int32(data=42)]
    >>> harness.log
    [Record(severity='INFO', text='2 x 21')]

    A receiver that is busy holds up the node, as it would in a project:

    >>> harness.block("double")
    >>> harness.send("number", Int32(data=1), Int32(data=2), Int32(data=3))
    >>> harness.run()
    1
    >>> harness.explain()
    ['is blocked on `node.double -> receiver.double` (1 outstanding, last acknowledged 0.0 s ago)']
    >>> harness.unsent("number")
    1
    >>> harness.acknowledge("double")
    >>> harness.run()
    1

    By default each input has one lossless connection, from a node ``sender``, and each output one
    to a node ``receiver``. A failing hook makes :meth:`run` raise ``HookError``. Hooks run with the
    node's environment variables, current folder and import path.

    Attributes:
        log: the records of the node; Python's ``logging`` has them, too (``neuros.<name>``).
        shutdown_reason: the argument of the plugin's ``node.shutdown``, ``None`` before.
        file: the node, with its connections.

    Args:
        plugin: the plugin file, the name of an installed module, or functions with a decorator of
            :mod:`neuros.hooks`, one or a list; they run as they are, in this program.
        inputs, outputs: message type by name of the port.
        connections: those that differ, ``wire("camera.image -> node.view", discard_limit=3)``.
        environment: environment variables of the node.
        name: the node's name.
        copies: its number of copies; the types of the ports are those of one.
        run_folder: the run folder, a temporary one if not given.
        restore: values that the plugin gets back by ``node.keep``, by name.

    Raises:
        PluginError, HookError: if the plugin cannot be imported, or declares its hooks wrongly.
        ValueError: if a connection does not fit the ports.
        UsageError: if a function has no such decorator.
    """

    def __init__(
        self,
        plugin: Plugin,
        *,
        inputs: Mapping[str, str] | None = None,
        outputs: Mapping[str, str] | None = None,
        connections: Sequence[Connection] = (),
        environment: Mapping[str, str] | None = None,
        name: str = "node",
        copies: int | None = None,
        run_folder: Path | None = None,
        restore: Mapping[str, Any] | None = None,
    ) -> None:
        hooks, module = functions_of(plugin), ""
        if hooks:
            path = file_of(hooks)
        else:
            written = plugin_key(plugin) or ""
            path = Path(written).resolve()
            if not path.exists() and is_module_name(written):
                module = written
                if (found := find_module(module)) is None:
                    raise no_module(module)
                path = found
        node = Node(
            name=name,
            container="neuros_python",
            plugin=path,
            inputs=ports(inputs or {}, copies),
            outputs=ports(outputs or {}, copies),
            environment=dict(environment or {}),
            file=path,
            module=module,
            hooks=hooks,
            copies=copies,
        )
        wires = with_neighbours(node, connections)
        project = path.parent if path.exists() else Path.cwd()
        self._open(node, wires, project, WORKSPACE, run_folder, restore)

    @classmethod
    def from_project(
        cls,
        project: str | os.PathLike[str],
        node_name: str,
        *,
        environment: Mapping[str, str] | None = None,
        overrides: Sequence[str] = (),
        workspace: Path = WORKSPACE,
        run_folder: Path | None = None,
        restore: Mapping[str, Any] | None = None,
    ) -> PluginHarness:
        """A node of a project, with its connections in that project.

        Args:
            project: the project file, or a folder with a ``project.json``.
            environment: variables that differ from the project's.
            overrides: as ``--set`` takes them.
            workspace: the folder that ``@path`` starts from.

        Raises:
            ProjectError: with every problem of the project.
            KeyError: if it has no such node.
        """
        path = Path(project)
        packages = workspaces_of(path if path.is_dir() else path.parent, workspace)
        loaded = load_project(
            path, workspace=workspace, overrides=overrides, packages=packages
        ).project
        node = _with_environment(loaded.node(node_name), environment)
        own = [c for c in loaded.connections if node_name in (c.source_node, c.destination_node)]
        harness = cls.__new__(cls)
        wires = with_observer(node, own)
        harness._open(node, wires, loaded.folder, workspace, run_folder, restore)
        return harness

    @classmethod
    def from_node_file(
        cls,
        node_file: str | os.PathLike[str],
        *,
        connections: Sequence[Connection] = (),
        environment: Mapping[str, str] | None = None,
        workspace: Path = WORKSPACE,
        run_folder: Path | None = None,
        restore: Mapping[str, Any] | None = None,
    ) -> PluginHarness:
        """The node that a node file describes; each port has a connection, as in the constructor.

        Raises:
            ProjectError: with every problem of the file.
        """
        file = Path(node_file).resolve()
        with tempfile.TemporaryDirectory() as folder:
            project = Path(folder) / "project.json"
            project.write_text(json.dumps({"nodes": [file.name], "connections": []}))
            packages = workspaces_of(file.parent, workspace)
            loaded = load_project(
                project, workspace=workspace, folder=file.parent, packages=packages
            ).project
        node = _with_environment(loaded.nodes[0], environment)
        harness = cls.__new__(cls)
        wires = with_neighbours(node, connections)
        harness._open(node, wires, file.parent, workspace, run_folder, restore)
        return harness

    def _open(
        self,
        node: Node,
        connections: tuple[Connection, ...],
        project: Path,
        workspace: Path,
        run_folder: Path | None,
        restore: Mapping[str, Any] | None,
    ) -> None:
        if run_folder is None:
            folder = Path(tempfile.mkdtemp(prefix="neuros-"))
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        else:
            folder = run_folder.resolve()
        messages = provide_messages(node, workspaces_of(project, workspace))
        folders = Folders(project, workspace, folder)
        restored = restore_values(restore or {}, folder / node.name)
        file = NodeFile(node, connections, folders, messages=messages, restored=restored)
        self.log: list[Record] = []
        self.shutdown_reason: str | None = None
        self.file = file
        self._failure: NeurosError | None = None
        self._is_final = False
        self._clock = ManualClock()
        self._loop = StepLoop(self._clock)
        self._topics = Topics()
        bench = Workbench(self._loop, self._topics, self.log)
        self._ends = Neighbours(file, bench.hub)
        self._contexts = ContextSwitch()
        self._contexts.hide_from_nodes(file.folders.project)
        (file.folders.run / file.node.name).mkdir(parents=True, exist_ok=True)
        with self._in_context():
            self._runtime = NodeRuntime(
                file,
                bench,
                self._contexts,
                tell=self._receive,
                fail=self._fail,
                log_file=None,
                duration_sim_s=None,
            )
            self._runtime.load()
        self._loop.post(self._runtime.start)

    # ------------------------------------------------------------------ steps

    def run(self, executions: int | None = None) -> int:
        """Run hooks until none is ready, or until ``executions`` have run; returns how many have.

        Raises:
            HookError: a hook fails; every later call raises the error again.
            NodeError: hooks go on for ever and ``executions`` was not given.
        """
        before, limit = self._executions(), _MOST_STARTS if executions is None else executions
        with self._in_context():
            while self._executions() - before < limit and self._loop.step():
                self._raise_failure()
        self._raise_failure()
        ran = self._executions() - before
        if executions is None and ran >= _MOST_STARTS:
            last = self._engine.hooks()[-1].name  # ordered by execution
            raise NodeError(
                f"hooks have run {ran} times with no end, the last of them '{last}': one that"
                " requires no input runs without pause; use run(executions=...), or block an output"
            )
        return ran

    def advance(self, seconds: float) -> int:
        """Advance the clock: run ready hooks, then each tick at its time; returns how many ran.

        Raises:
            HookError, NodeError: as :meth:`run`.
        """
        before = self._executions()
        end_ns = self._clock.now_ns + round(seconds * 1e9)
        self.run()
        while (due_ns := self._loop.next_due_ns) is not None and due_ns <= end_ns:
            with self._in_context():
                self._loop.advance_to(due_ns)
            self.run()
        self._loop.advance_to(end_ns)
        return self._executions() - before

    def finalise(self) -> None:
        """End the node: run its finalise hooks; a second call has no effect.

        Raises:
            HookError: a finalise hook fails.
        """
        if self._is_final:
            return
        self._is_final, failure = True, self._failure
        with self._in_context():
            self._runtime.finalise()
        if failure is None:
            self._raise_failure()

    def __enter__(self) -> PluginHarness:
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        with contextlib.suppress(*([NeurosError] if error else [])):
            self.finalise()

    @property
    def node(self) -> NodeHandle:
        """The ``node`` that hooks receive."""
        return self._runtime.handle

    @property
    def run_dir(self) -> Path:
        """The node's own folder."""
        return self._runtime.run_dir

    @property
    def kept(self) -> dict[str, Any]:
        """What the plugin keeps (``node.keep``), by name: its values of now."""
        with self._in_context():
            return self._runtime.keeping.values()

    @property
    def time_s(self) -> float:
        """Seconds advanced by :meth:`advance`."""
        return self._clock.now_ns / 1e9

    @property
    def sim_time_s(self) -> float | None:
        """Simulated time of a node that owns a simulator or publishes a clock, else ``None``."""
        return self._runtime.sim_time

    @property
    def executions(self) -> dict[str, int]:
        """Number of executions of each hook."""
        hooks = snapshot(self._engine, self._clock())["hooks"]
        return {name: entry["executions"] for name, entry in hooks.items()}

    @property
    def connections(self) -> dict[str, dict[str, Any]]:
        """The counters by connection, as ``run.json`` has them: sent, received, discarded, ..."""
        books = snapshot(self._engine, self._clock())
        outgoing, incoming = books["outgoing"], books["incoming"]
        return {
            name: {**outgoing.get(name, {}), **incoming.get(name, {})}
            for name in {**outgoing, **incoming}
        }

    def explain(self) -> list[str]:
        """Why nothing moves, in the words of the stall explainer."""
        return explain(self._engine, self._clock())

    # ------------------------------------------------------------------ what goes in

    def make_packet(self, port: str) -> Any:
        """A new packet for an input (or else an output): default values, an array of zeros."""
        return make_packet(self._port(port, "port", self._inputs | self._outputs).type)

    def send(self, input_name: str, *packets: Any, source: str | None = None) -> None:
        """Send packets to an input; packets that its connection does not let through yet wait.

        They are copied now, and arrive at the next :meth:`run`.

        Args:
            source: the connection, ``"camera"`` or ``"camera.image"``, where there are several.

        Raises:
            TypeError, ValueError: a packet has another type, or a value that no node may send;
                none of the packets is sent then.
        """
        port = self._port(input_name, "input", self._inputs)
        packets = tuple(checked(port, packet) for packet in packets)
        if port.external_topic is not None:
            for packet in packets:
                self._loop.post(partial(self._topics.deliver, port, copy_packet(packet)))
            return
        connections = self._from(input_name, source)
        if len(connections) != 1:
            names = ", ".join(f"{c.source_node}.{c.source_output}" for c in connections)
            raise ValueError(f"input '{input_name}': say which source: {names or 'it has none'}")
        for packet in packets:
            self._ends.send(connections[0], packet)

    def unsent(self, input_name: str, source: str | None = None) -> int:
        """Number of packets that wait at their sender until the node starts on earlier ones."""
        self._port(input_name, "input", self._inputs)
        return self._ends.unsent(self._from(input_name, source))

    # ------------------------------------------------------------------ what comes out

    def received(self, output: str, receiver: str | None = None, start: int = 0) -> list[Any]:
        """The packets of an output so far, oldest first.

        Args:
            receiver: ``"viewer"`` or ``"viewer.image"``; all receivers get the same packets.
            start: how many of the oldest to leave out.
        """
        port = self._port(output, "output", self._outputs)
        if port.external_topic is not None:
            return list(self._topics.published.get(output, ()))[start:]
        return self._ends.received[self._to(output, receiver)[0]][start:]

    def block(self, output: str, receiver: str | None = None) -> None:
        """Make receivers of an output busy: they start on no further packet."""
        self._ends.busy.update(self._to(output, receiver))

    def acknowledge(self, output: str, count: int | None = 1, receiver: str | None = None) -> None:
        """Let busy receivers start on ``count`` packets (``None``: all); they stay busy."""
        for connection in self._to(output, receiver):
            self._ends.start_on(connection, count)

    def unblock(self, output: str, receiver: str | None = None) -> None:
        """Let receivers start on all packets they have, and on each new one at once."""
        self._ends.busy.difference_update(self._to(output, receiver))
        self.acknowledge(output, None, receiver)

    # ------------------------------------------------------------------ inside

    @property
    def _engine(self) -> Engine:
        assert self._runtime.engine is not None
        return self._runtime.engine

    def _executions(self) -> int:
        return sum(hook.executions for hook in self._engine.all_hooks)

    def _receive(self, message: Message) -> None:
        if isinstance(message, Shutdown) and self.shutdown_reason is None:
            self.shutdown_reason = message.reason

    def _fail(self, _: str, error: NeurosError) -> None:
        self._failure = self._failure or error
        self._runtime.stop()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    @contextlib.contextmanager
    def _in_context(self) -> Iterator[None]:
        """Switch to the context of the node, and back to that of the test."""
        folder = os.getcwd()
        os.chdir(self.file.folders.run)
        try:
            yield
        finally:
            self._contexts.leave()
            os.chdir(folder)

    @property
    def _inputs(self) -> dict[str, Port]:
        return {port.name: port for port in self.file.node.inputs}

    @property
    def _outputs(self) -> dict[str, Port]:
        return {port.name: port for port in self.file.node.outputs}

    def _port(self, name: str, side: str, known: Mapping[str, Port]) -> Port:
        if name not in known:
            has = ", ".join(known) or "none"
            raise ValueError(f"node '{self.file.node.name}' has no {side} '{name}' (it has {has})")
        return known[name]

    def _from(self, input_name: str, source: str | None) -> list[Connection]:
        return [
            c
            for c in self._ends.incoming
            if c.destination_input == input_name
            and source in (None, c.source_node, f"{c.source_node}.{c.source_output}")
        ]

    def _to(self, output: str, receiver: str | None) -> list[Connection]:
        self._port(output, "output", self._outputs)
        found = [
            c
            for c in self._ends.outgoing
            if c.source_output == output
            and receiver
            in (None, c.destination_node, f"{c.destination_node}.{c.destination_input}")
        ]
        if not found:
            raise ValueError(f"output '{output}' has no such receiver: {receiver or 'none at all'}")
        return found


def _with_environment(node: Node, environment: Mapping[str, str] | None) -> Node:
    return replace(node, environment={**node.environment, **(environment or {})})


def workspaces_of(project: Path, workspace: Path) -> Workspaces:
    """The workspaces of a project in this folder, besides the packages of ROS."""
    return Workspaces(project.resolve() / "workspace", workspace, os.environ)


def provide_messages(node: Node, workspaces: Workspaces) -> tuple[Path, ...]:
    """Build the messages of a node and put them on ``sys.path``; returns their folders.

    Raises:
        ProjectError: with all mistakes in message files.
        EnvironmentFault: if they cannot be built.
    """
    messages = Messages.of_nodes([node], workspaces)
    if problems := messages.problems():
        raise ProjectError(problems)
    if not messages.is_made:
        messages.make(Progress(sys.stderr), without_mark(os.environ))
    sys.path[:0] = [path for path in map(str, messages.paths) if path not in sys.path]
    return messages.paths
