"""Test bench of one node: the real runtime and engine, stepped by the test."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from neuros.control import Message, Shutdown
from neuros.engine.engine import Engine
from neuros.engine.send_window import SendWindow
from neuros.engine.snapshot import snapshot
from neuros.errors import NeurosError, NodeError
from neuros.node.context import ContextSwitch
from neuros.node.handle import NodeHandle
from neuros.node.node import NodeRuntime
from neuros.project.model import Connection, NodeFile, Port
from neuros.testing.stand_ins import ManualClock, Record, StepLoop, Topics, Workbench
from neuros.transport.lean_node import without_spinning
from neuros.transport.memory import MemoryHub
from neuros.transport.messages import decode, encode

_MANY = 10_000
"""Hook executions after which :meth:`NodeBench.run` takes it that they will never end."""
_Bench = TypeVar("_Bench", bound="NodeBench")


class Neighbours:
    """All nodes around one node (:class:`neuros.ports.Inbox` of each).

    Towards the node they keep the rules of each connection: what it does not take yet waits here.
    What it sends they start on at once, and so acknowledge, unless they are busy.
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
        """Send a packet, or keep it until the connection lets it through."""
        self._waiting[connection].append(decode(encode(packet)))
        self._send_waiting(connection)

    def unsent(self, connections: Sequence[Connection]) -> int:
        """Packets that wait for the node to take earlier ones."""
        return sum(len(self._waiting[connection]) for connection in connections)

    def start_on(self, connection: Connection, count: int | None) -> None:
        """Let a busy receiver start on ``count`` packets, or on all that it has."""
        started = self._started[connection]
        arrived = len(self.received[connection])
        position = arrived if count is None else min(arrived, started + count)
        if position > started:
            self._started[connection] = position
            if connection.is_reliable:
                node = self._hub.inboxes[connection.source_node]
                self._hub.post(partial(node.on_acknowledgement, connection, position))

    # ------------------------------------------------------------------ inbox

    def on_packet(self, connection: Connection, packet: Any) -> None:
        """The node has sent a packet."""
        self.received[connection].append(packet)
        if connection not in self.busy:
            self.start_on(connection, None)

    def on_external_packet(self, port: Port, packet: Any) -> None:
        """Neighbours have no external topics."""

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        """The node has started on packets: more may be sent."""
        self._windows[connection].credit(position, 0)
        self._send_waiting(connection)

    def on_registered(self, connection: Connection) -> None:
        """The node is always there."""

    def _send_waiting(self, connection: Connection) -> None:
        window, waiting = self._windows[connection], self._waiting[connection]
        while waiting and not window.is_blocked:
            window.spend(0)
            node = self._hub.inboxes[connection.destination_node]
            self._hub.post(partial(node.on_packet, connection, waiting.popleft()))


class NodeBench:
    """Runs one node step by step.

    Attributes:
        log: what the node has logged; it goes to Python's ``logging`` as well (``neuros.<name>``).
        shutdown_reason: what the plugin gave to ``node.shutdown``, ``None`` before.
    """

    def __init__(self, file: NodeFile) -> None:
        self.log: list[Record] = []
        self.shutdown_reason: str | None = None
        self._file = file
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
        with self._on_stage():
            self._runtime = NodeRuntime(
                file,
                bench,
                self._contexts,
                tell=self._listen,
                fail=self._fail,
                log_file=None,
                duration_sim_s=None,
                clock=self._clock,
            )
            self._runtime.load()
        self._loop.post(self._runtime.start)

    def run(self, executions: int | None = None) -> int:
        """Run hooks until none is ready, or until so many have run; returns how many have.

        Raises:
            HookError: if one fails; again at every later call.
            NodeError: if they go on for ever and ``executions`` was not given.
        """
        before, limit = self._executions(), _MANY if executions is None else executions
        with self._on_stage():
            while self._executions() - before < limit and self._loop.step():
                self._raise_failure()
        self._raise_failure()
        ran = self._executions() - before
        if executions is None and ran >= _MANY:
            last = self._engine.hooks()[-1].name  # they are in the order of their execution
            raise NodeError(
                f"hooks have run {ran} times with no end, the last of them '{last}': one that"
                " requires no input runs without pause; use run(executions=...), or block an output"
            )
        return ran

    def advance(self, seconds: float) -> int:
        """Let time pass: run what is ready, then each tick at its time; returns how many ran.

        Raises:
            HookError, NodeError: as :meth:`run`.
        """
        before = self._executions()
        end_ns = self._clock.now_ns + round(seconds * 1e9)
        self.run()
        while (due_ns := self._loop.next_due_ns) is not None and due_ns <= end_ns:
            with self._on_stage():
                self._loop.advance_to(due_ns)
            self.run()
        self._loop.advance_to(end_ns)
        return self._executions() - before

    def finalise(self) -> None:
        """End the node: run its finalise hooks; a second call has no effect.

        Raises:
            HookError: if one of them fails.
        """
        if self._is_final:
            return
        self._is_final, failure = True, self._failure
        with self._on_stage():
            self._runtime.finalise()
        if failure is None:
            self._raise_failure()

    def __enter__(self: _Bench) -> _Bench:
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
    def time_s(self) -> float:
        """Seconds that have passed by :meth:`advance`."""
        return self._clock.now_ns / 1e9

    @property
    def sim_time_s(self) -> float | None:
        """Simulated time of a node that owns a simulator or publishes a clock, else ``None``."""
        return self._runtime.sim_time

    @property
    def executions(self) -> dict[str, int]:
        """How often each hook has run."""
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
        return self._runtime.reports.explain()

    # ------------------------------------------------------------------ inside

    @property
    def _engine(self) -> Engine:
        assert self._runtime.engine is not None
        return self._runtime.engine

    def _executions(self) -> int:
        return sum(hook.executions for hook in self._engine.all_hooks)

    def _listen(self, message: Message) -> None:
        if isinstance(message, Shutdown) and self.shutdown_reason is None:
            self.shutdown_reason = message.reason

    def _fail(self, _: str, error: NeurosError) -> None:
        self._failure = self._failure or error
        self._runtime.stop()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    @contextlib.contextmanager
    def _on_stage(self) -> Iterator[None]:
        """The context of the node for a while; that of the test again afterwards."""
        folder = os.getcwd()
        os.chdir(self._file.folders.run)
        try:
            with without_spinning():
                yield
        finally:
            self._contexts.leave()
            os.chdir(folder)
