"""One running node: its plugin on an engine, the engine on a transport."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from neuros.core.engine import Engine
from neuros.core.explain import explain
from neuros.core.hook import Hook
from neuros.core.ledger import snapshot
from neuros.errors import HookError, NeurosError, NodeError, PluginError
from neuros.hooks import HookKind, HookSpec
from neuros.ports import Logger, Middleware, Tap, Way
from neuros.project.model import Connection, NodeFile, Port
from neuros.runtime.handle import NodeHandle
from neuros.runtime.packet_books import PacketBooks
from neuros.runtime.plugin import describe, load_plugin, plugin_traceback
from neuros.runtime.scope import Stage
from neuros.runtime.timeline import Timeline

CLOCK_TYPE = "rosgraph_msgs/msg/Clock"


class NodeRuntime:
    """Joins plugin, engine and transport of one node; it is the effects of the one, the inbox of
    the other, and what stands behind ``node``.

    Args:
        tell: reports to the supervisor, ``tell(kind, **fields)``.
        fail: called with an error that ends the project.
        tap: where packets go that are recorded, ``None``: none are.
        duration_sim_s: simulated time at which this node ends the project, ``None``: never.
        on_initialised: called after each initialise hook.
        clock: monotonic clock in nanoseconds.
        make_engine: the engine, called like its class.

    Attributes:
        waiting_threads: those that wait until packets that they have offered are sent.
    """

    def __init__(
        self,
        file: NodeFile,
        middleware: Middleware,
        stage: Stage,
        *,
        tell: Callable[..., object],
        fail: Callable[[str, NeurosError], None],
        tap: Tap | None = None,
        log_file: Path | None,
        duration_sim_s: float | None,
        on_initialised: Callable[[], None] = lambda: None,
        clock: Callable[[], int] = time.monotonic_ns,
        make_engine: Callable[..., Engine] = Engine,
    ) -> None:
        self.file = file
        self.name = file.node.name
        self.is_ending = False
        self.waiting_threads: set[threading.Thread] = set()
        self._middleware = middleware
        self._stage = stage
        self._tell = tell
        self._fail = fail
        self._tap = tap
        self._kept_on_arrival = frozenset(
            c for c in file.connections if tap is not None and tap.wants(Way.RECEIVED, str(c))
        )
        self._duration_sim_s = duration_sim_s if file.node.owns_time else None
        self._on_initialised = on_initialised
        self._clock = clock
        self._make_engine = make_engine
        self._has_run = False
        self._read_time_s: Callable[[], float] | None = None
        self._timeline = Timeline() if file.node.owns_time else None
        self._clock_ports = {p.name for p in file.node.outputs if p.type == CLOCK_TYPE}
        self._closers: list[Callable[[], None]] = []
        self._specs: Sequence[HookSpec] = ()
        self.engine: Engine | None = None
        self._books: PacketBooks | None = None
        environment = {**file.node.environment, "NEUROS_RUN_DIR": str(self.run_dir)}
        self._scope = stage.scope(environment, file.node.plugin, file.folders.project, log_file)
        self._stage.enter(self._scope)
        self._transport = middleware.transport(file)
        self.logger: Logger = middleware.ros_node(file).get_logger()
        self.handle = NodeHandle(file, middleware.ros_node(file), self)

    @property
    def run_dir(self) -> Path:
        """The node's own folder."""
        return self.file.folders.run / self.name

    @property
    def specs(self) -> Sequence[HookSpec]:
        """The hooks of its plugin, once that is loaded."""
        return self._specs

    @property
    def is_on_stage(self) -> bool:
        """Whether the process has the surroundings of this node now."""
        return self._stage.has(self._scope)

    # ------------------------------------------------------------------ life

    def load(self) -> None:
        """Open the transport (others may look for it from now on) and import the plugin.

        Raises:
            PluginError, HookError: if the plugin is at fault.
        """
        self._stage.enter(self._scope)
        self._transport.open(self)
        self._middleware.mark_own_entities(self.file, lambda: self._stage.enter(self._scope))
        self._specs = load_plugin(self.file.node.plugin, self.name)
        types = {
            port.name: self._middleware.message_class(port.type) for port in self.file.node.outputs
        }
        self.engine = self._make_engine(
            self.file.node,
            self.file.connections,
            self._specs,
            self,
            self._clock,
            types,
        )
        self._books = PacketBooks(self.engine, self._transport.digests, self.run_dir)
        self._say_what_is_special(self.engine)

    def start(self) -> None:
        """Let the engine run hooks as soon as every receiver is there."""
        if any(spec.kind is HookKind.TICK for spec in self._specs):
            engine = self._loaded
            self._middleware.loop.add_timer(lambda: engine.next_due_ns, self.on_timer)
        self._guard(self._loaded.start)

    def drain(self) -> None:
        """Stop the hooks that send unasked."""
        self._loaded.drain()

    def stop(self) -> None:
        """Start no further hook. Any thread."""
        self.is_ending = True
        if self.engine is not None:
            self.engine.stop_hooks()

    def finalise(self) -> None:
        """Run the finalise hooks and give up what the plugin holds; each fault is reported."""
        self.stop()
        self._stage.enter(self._scope)
        if self.engine is not None:
            for spec in self._specs:
                if spec.kind is HookKind.FINALISE:
                    self._guard(lambda spec=spec: self._run_spec(spec, ()))  # type: ignore[misc]
        if self._tap is not None:
            self._tap.close()
            self._tap = None
        for close in reversed(self._closers):
            try:
                close()
            except BaseException as error:  # the others must be closed all the same
                self._fail(self.name, _failed_to_close(error))

    # ------------------------------------------------------------------ inbox

    def on_packet(self, connection: Connection, packet: Any) -> None:
        """A packet has arrived on a connection."""
        if connection in self._kept_on_arrival:
            self._keep(Way.RECEIVED, str(connection), packet)
        try:
            self._loaded.on_packet(connection, packet)
        except NeurosError as error:
            self._fail(self.name, error)

    def on_external_packet(self, port: Port, packet: Any) -> None:
        """A packet has arrived on an external topic."""
        if self._tap is not None:
            self._keep(Way.HEARD, port.name, packet)
        self._guard(lambda: self._loaded.on_packet(port.name, packet))

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        """The receiver of a connection has started on packets."""
        try:
            self._loaded.on_acknowledgement(connection, position)
        except NeurosError as error:
            self._fail(self.name, error)

    def on_registered(self, connection: Connection) -> None:
        """The receiver of a connection is there."""
        self._guard(lambda: self._loaded.on_registered(connection))

    def on_timer(self) -> None:
        """The next due time of a hook has come."""
        self._guard(self._loaded.on_timer)

    # ------------------------------------------------------------------ effects

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook in the surroundings of its node."""
        self._stage.enter(self._scope)
        if not self._has_run:
            self._has_run = True
            self._tell("first_hook", node=self.name)
        box = [self._run_spec(hook.spec, arguments)]
        if hook.spec.kind is HookKind.INITIALISE:
            self._on_initialised()
        if hook.outputs:
            self._transport.note_result(box)
        if self._timeline is not None:
            self._look_at_time(self._timeline)
        return box[0]

    def send(self, connections: Sequence[Connection], packet: Any) -> None:
        """Send on connections to other nodes."""
        if self._clock_ports and connections[0].source_output in self._clock_ports:
            self._note_clock(packet)
        data = self._transport.send(connections, packet)
        if self._tap is not None:
            self._keep(Way.SENT, connections[0].source_output, packet, data)

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on an external topic."""
        if port.name in self._clock_ports:
            self._note_clock(packet)
        self._transport.send_external(port, packet)
        if self._tap is not None:
            self._keep(Way.SENT, port.name, packet)

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Tell a sender how far every taker has come."""
        self._transport.acknowledge(connection, position)

    def post(self, event: Callable[[], None]) -> None:
        """Queue a delivery of the node to itself."""
        self._middleware.loop.post(partial(self._guard, event))

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Queue the loop-back."""
        self._middleware.loop.post_loop_back(partial(self._guard, event))

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        """What the node gets on a connection to itself: it shares nothing with this packet."""
        if self._tap is not None:
            self._keep(Way.TO_ITSELF, str(connection), packet)
        return self._middleware.copy(packet)

    # ------------------------------------------------------------------ behind `node`

    def make_packet(self, type_name: str) -> Any:
        """A new message with default values."""
        return self._transport.make_packet(type_name)

    def shutdown(self, reason: str, drain_s: float) -> None:
        """Ask the supervisor for a drained end; this node starts no further hook."""
        if self.engine is not None:
            self.engine.stop_hooks()
        self._tell("shutdown", node=self.name, reason=reason, drain_s=drain_s)

    def own_simulated_time(self, read_s: Callable[[], float]) -> None:
        """Take simulated time from a simulator, rather than from a clock that it publishes."""
        self._read_time_s = read_s
        self._clock_ports.clear()

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call back when the node ends."""
        self._closers.append(callback)

    def fail_from_thread(self, error: BaseException) -> None:
        """End the project with an error that happened outside the hooks."""
        wrapped = error if isinstance(error, NeurosError) else NodeError(describe(error))
        if wrapped is not error:
            wrapped.__cause__ = error
        self._middleware.loop.post_from_thread(lambda: self._fail(self.name, wrapped))

    def offer_from_thread(
        self, packets: Mapping[str, Any], accepted: Callable[[], None]
    ) -> Callable[[Callable[[], None]], None]:
        """Offer packets from another thread; returns a function that withdraws them."""
        withdrawals: list[Callable[[], None]] = []
        thread = threading.current_thread()

        def accept() -> None:
            self.waiting_threads.discard(thread)
            accepted()

        def offer() -> None:
            self.waiting_threads.add(thread)
            withdrawals.append(self._loaded.offer(packets, accept))
            if self._timeline is not None:
                self._look_at_time(self._timeline)

        def withdraw(done: Callable[[], None]) -> None:
            def event() -> None:
                self.waiting_threads.discard(thread)
                for each in withdrawals:
                    each()
                done()

            self._middleware.loop.post_from_thread(event)

        self._middleware.loop.post_from_thread(lambda: self._guard(offer))
        return withdraw

    # ------------------------------------------------------------------ reports

    def write_books(self) -> None:
        """Write out when packets were sent and taken. Any thread."""
        if self._books is not None:
            self._books.write()

    def report(self) -> dict[str, Any]:
        """State and counters. Any thread."""
        now_ns = self._clock()
        engine, sim_time = self.engine, self.sim_time
        if self._timeline is not None and sim_time is not None:
            self._timeline.note(sim_time, now_ns / 1e9)
        return {
            "node": self.name,
            "has_run": self._has_run,
            "waiting_for": [str(each) for each in self._transport.waiting_for()],
            "sim_time": sim_time,
            "timeline": self._timeline.take() if self._timeline is not None else [],
            "running_since_s": engine.tick_start_ns / 1e9 if engine and engine.is_running else None,
            "ledger": None if engine is None else snapshot(engine, now_ns),
            "fault": None if self._books is None else self._books.failure,
        }

    def probe(self) -> dict[str, Any]:
        """A report with what only a moment between two events can tell. Loop thread only."""
        engine = self._loaded
        return {
            **self.report(),
            "is_startable": engine.has_startable_packet,
            "is_wakeable": engine.is_wakeable
            or (not engine.is_stopped and self._middleware.has_foreign_entities(self.file)),
            "is_running": engine.is_running,
        }

    def explain(self) -> list[str]:
        """Why nothing moves here. Any thread."""
        if self.engine is None:
            return [f"imports its plugin {self.file.node.plugin.name}"]
        return explain(self.engine, self._clock())

    @property
    def sim_time(self) -> float | None:
        """Simulated seconds, ``None`` where the node owns no time."""
        return None if self._read_time_s is None else self._read_time_s()

    # ------------------------------------------------------------------ inside

    @property
    def _loaded(self) -> Engine:
        assert self.engine is not None
        return self.engine

    def _keep(self, way: Way, name: str, packet: Any, data: bytes | None = None) -> None:
        """Record a packet, where that is wanted; ``data`` is the packet, if serialised already."""
        tap = self._tap
        if tap is None or not tap.wants(way, name):
            return
        try:
            tap.keep(way, name, data or self._middleware.encode(packet), self.sim_time)
        except OSError as error:
            self._tap = None
            tap.close()
            self.logger.error(
                f"its packets are not recorded from now on: {error.strerror}; the run goes on"
            )

    def _guard(self, event: Callable[[], None]) -> None:
        try:
            event()
        except NeurosError as error:
            self._fail(self.name, error)

    def _run_spec(self, spec: HookSpec, arguments: Sequence[Any]) -> Any:
        try:
            return spec.function(self.handle, *arguments)
        except HookError:
            raise
        except BaseException as error:
            raise HookError(describe(error), hook=spec.name, where=spec.where) from error

    def log_failure(self, error: NeurosError) -> None:
        """Write an error to the node's log, with the plugin's traceback if it is the plugin's."""
        self._stage.enter(self._scope)
        cause = error.__cause__
        is_shown = isinstance(error, PluginError)  # its text has the traceback already
        if isinstance(error, NodeError) and cause is not None and not is_shown:
            self.logger.error(f"{error}\n{plugin_traceback(cause, self.file.node.plugin)}")
        else:
            self.logger.error(str(error))

    def _note_clock(self, packet: Any) -> None:
        seconds = packet.clock.sec + packet.clock.nanosec * 1e-9
        self._read_time_s = lambda: seconds
        if self._timeline is not None:
            self._look_at_time(self._timeline)

    def _look_at_time(self, timeline: Timeline) -> None:
        """Simulated time may have gone on; it may be over."""
        time_s = self.sim_time
        if time_s is None:
            return
        timeline.note(time_s, self._clock() / 1e9)
        if self._duration_sim_s is not None and time_s >= self._duration_sim_s - 1e-9:
            limit, self._duration_sim_s = self._duration_sim_s, None
            self.shutdown(f"{limit:g} s of simulated time", 5.0)

    def _say_what_is_special(self, engine: Engine) -> None:
        for hook in engine.free_running_hooks():
            self.logger.info(f"hook '{hook.name}' requires no input: it runs without pause")
        for inlet in engine.untaken_inlets():
            self.logger.warning(
                f"no hook takes input '{inlet.input_name}': packets on {inlet.name} are"
                " acknowledged on arrival and dropped"
            )


def _failed_to_close(error: BaseException) -> NodeError:
    wrapped = NodeError(f"failed while it was closed: {describe(error)}")
    wrapped.__cause__ = error
    return wrapped
