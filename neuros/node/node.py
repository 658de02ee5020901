"""One running node: its plugin on an engine, the engine on a transport."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from neuros.arithmetic import note_arithmetic
from neuros.control import AtRest, Finalising, Message, Progress, Ready, Shutdown
from neuros.control.link import to_bytes
from neuros.engine.engine import Engine
from neuros.engine.hook import Hook
from neuros.engine.node_ports import PacketType
from neuros.engine.sim_clock import with_clocks
from neuros.errors import ControlError, HookError, NeurosError, NodeError, ProtocolError
from neuros.hooks import HookKind, HookSpec, hook_specs_of
from neuros.node.context import Context, ContextSwitch
from neuros.node.failures import Failures, as_node_error
from neuros.node.handle import NodeHandle, PluginServices, Results
from neuros.node.instruments import Instrument, NodeRecorder, PacketHistories, Passage
from neuros.node.keeping import Keeping
from neuros.node.logs import WorldLog
from neuros.node.plugin import describe, last_line, load_plugin
from neuros.node.reports import NodeReports
from neuros.node.sampling import Sampler
from neuros.node.simulated_time import SimulatedTime
from neuros.node.virtual import Durations, VirtualTime
from neuros.ports import (
    Advance,
    Middleware,
    NodeEvents,
    NodeLoop,
    PacketRecorder,
    Transport,
    Way,
)
from neuros.project.model import Connection, NodeFile, Port
from neuros.project.timing import VIRTUAL

LAST_PACKETS = "last_packets"
"""In the folder of a node of a session: its newest packets, when the run has ended."""
_MOST_SAVED_BYTES = 1_000_000


class NodeRuntime:
    """Joins plugin, engine and transport of one node, and takes it through its lifecycle.

    It is the inbox of the transport; :class:`NodeEffects` are those of the engine, and
    :class:`PluginServices` those of ``node``.

    Args:
        tell: sends to the supervisor.
        fail: called with an error that ends the project.
        recorder: where packets go that are recorded, ``None``: none are.
        duration_sim_s: simulated time at which this node ends the project, ``None``: never.
        on_initialised: called after each initialise hook.
        make_engine: the engine, called like its class.
        is_held: whether hooks stand still from the start, as paused, and the newest packets of each
            output are kept.
        is_local: whether the session that holds it is in the same thread.
        drive: see :meth:`NodeHandle.drive`.

    Attributes:
        histories: the newest packets, where they are kept.
        engine: ``None`` until :meth:`load`; ``loaded``: the same, from then on.
        time: its simulated time.
        specs: the hooks of its plugin, once that is loaded; after a reset, those that hold then.
        handle: the ``node`` that hooks receive.
        keeping: what its plugin keeps.
        failures: reports its errors.
        reports: what it says of itself.
    """

    loaded: Engine

    def __init__(
        self,
        file: NodeFile,
        middleware: Middleware,
        contexts: ContextSwitch,
        *,
        tell: Callable[[Message], object],
        fail: Callable[[str, NeurosError], None],
        recorder: PacketRecorder | None = None,
        log_file: Path | None,
        duration_sim_s: float | None,
        on_initialised: Callable[[], None] = lambda: None,
        make_engine: Callable[..., Engine] = Engine,
        is_held: bool = False,
        is_local: bool = False,
        drive: Callable[[Advance], bool] = lambda _: False,
    ) -> None:
        self.file = file
        self.name = file.node.name
        self.specs: Sequence[HookSpec] = ()
        self._plugin: Sequence[HookSpec] = ()
        self._has_timer = False
        self.engine: Engine | None = None
        self._middleware = middleware
        self._loop = middleware.loop_of(file)
        self._clock = clock = self._loop.clock
        # The same loop, if the run is in virtual time.
        self._virtual = cast(NodeLoop, self._loop) if file.time == VIRTUAL else None
        self._make_engine = make_engine
        self._tell = tell
        self._contexts = contexts
        environment = self._environment({})
        are_functions = bool(file.node.hooks)
        plugin = None if file.node.module or are_functions else file.node.plugin
        self._context = contexts.make_context(
            *(environment, plugin, file.folders.project, log_file), shares_modules=are_functions
        )
        self._enter = partial(contexts.enter, self._context)
        self._enter()
        self._transport = middleware.transport(file)
        ros_node = middleware.ros_node(file)
        self._logger = ros_node.get_logger()
        self.failures = Failures(self.name, file.node.plugin, self._logger, fail)
        self._guard = self.failures.guard
        virtual = self._virtual
        wall_ns = time.time_ns if virtual is None else (lambda: max(0, clock() - virtual.zero_ns))
        self.time = SimulatedTime(
            *(file.node, duration_sim_s, clock, self._end_by_duration, wall_ns)
        )
        sampler = Sampler(middleware.packets.encode)
        self.keeping = Keeping(self.name, self.run_dir, file.restored)
        self._services = PluginServices(
            middleware.packets,
            self._loop,
            self.time,
            self.failures,
            self._ask_for_end,
            lambda text: tell(Progress(self.name, text)),
            lambda look: self.reports.show_world(look),
            drive,
            Results(self.run_dir),
            self.keeping,
        )
        if self._virtual is not None:
            self._services.virtual_time = VirtualTime(
                self._virtual, lambda: self.loaded, self.failures
            )
        self.handle = NodeHandle(file, ros_node, self._services)
        self._recorder: NodeRecorder | None = None
        instruments: list[Instrument] = [self.time, sampler]
        if recorder is not None:
            self._recorder = NodeRecorder(
                recorder,
                middleware.packets.encode,
                lambda: self.time.now_s,
                wall_ns if self._virtual is not None else lambda: None,
                self._logger,
            )
            instruments.append(self._recorder)
        self._on_initialised = on_initialised
        self._uninitialised = 0  # initialise hooks that have not run
        self._is_held, self._is_local = is_held, is_local
        packets = middleware.packets
        copy_of = (lambda port: packets.copier(port.type)) if is_local else None
        self.histories = PacketHistories(packets.encode, copy_of)
        if is_held:
            instruments.append(self.histories)
        make_effects = NodeEffects if self._virtual is None else VirtualEffects
        self._effects = make_effects(
            middleware,
            file,
            self._loop,
            self._transport,
            self.handle,
            self.failures,
            self.time,
            instruments,
            contexts=contexts,
            context=self._context,
            on_ready=self._on_ready,
            on_initialised=self._on_hook_initialised,
        )
        world_log = None if recorder is None else WorldLog(self.run_dir, self._logger)
        self.reports = NodeReports(
            *(file, middleware, self._transport, self.time, sampler, clock),
            *(self._recorder, world_log, lambda: self.keeping.names),
        )
        node, passage = file.node, self._effects.passage
        arrivals = {
            c: passage(Way.RECEIVED, node.input(c.destination_input), c)
            for c in file.connections
            if c.destination_node == self.name != c.source_node
        }
        self._arrivals = {c: each for c, each in arrivals.items() if each.observers}
        self._heard = {p.name: passage(Way.HEARD, p) for p in node.inputs if p.external_topic}

    @property
    def run_dir(self) -> Path:
        """The node's own folder."""
        return self.file.folders.run / self.name

    @property
    def has_context(self) -> bool:
        return self._contexts.current is self._context

    @property
    def sim_time(self) -> float | None:
        """Simulated seconds, ``None`` where the node owns no time."""
        return self.time.now_s

    @property
    def is_paused(self) -> bool:
        """Whether its hooks stand still, but for steps."""
        return self.loaded.is_paused

    @property
    def waiting_threads(self) -> set[threading.Thread]:
        """Threads that wait until the packets that they have offered are sent."""
        return self._services.waiting_threads

    # ------------------------------------------------------------------ lifecycle

    def load(self) -> None:
        """Open the transport (others may look for it from now on) and import the plugin.

        Raises:
            PluginError, HookError: if the plugin is at fault.
        """
        self._enter()
        self._transport.open(self)
        self._middleware.mark_own_entities(
            self.file, self._enter_callback, self.failures.report_callback
        )
        self._load_plugin()
        self.reports.open(self._make(), self._logger)

    def start(self, *, awaits_others: bool = False) -> None:
        """Initialise as soon as every receiver is there, and then run the other hooks.

        ``awaits_others``: these wait for :meth:`activate`, too.
        """
        if not self._has_timer and any(spec.kind is HookKind.TICK for spec in self.specs):
            self._has_timer = True
            self._loop.add_timer(lambda: self.loaded.next_due_ns, self.on_timer)
        self._guard(partial(self.loaded.start, awaits_others=awaits_others))
        if not awaits_others:
            self._services.is_active.set()

    def activate(self) -> None:
        """Every node of the project is ready: tick and function hooks may start from now on."""
        if self._virtual is None:
            self._activate()
        else:
            self._virtual.at_zero(self._activate, self.on_timer)

    def _activate(self) -> None:
        if self._services.virtual_time is not None:
            self._services.virtual_time.activate()
        self._guard(self.loaded.activate)
        self._services.is_active.set()

    @property
    def why_not_reset(self) -> str:
        """Why its process has to be started anew for a reset; empty if :meth:`reset` will do."""
        node = self.file.node
        if self._recorder is not None:
            return "packets are recorded"
        if self._resets:
            return ""
        is_own = node.hooks or node.plugin.is_relative_to(self.file.folders.project)
        if node.module or not is_own:
            return f"the plugin of {self.name} is not in the project's folder"
        if self._middleware.has_foreign_entities(self.file):
            return f"the plugin of {self.name} has made ROS entities"
        return self._contexts.why_bound(self._context)

    def reset(self, variables: Mapping[str, str], keep: Sequence[str] = ()) -> None:
        """Be as after :meth:`load`, with these variables in the environment.

        What the plugin keeps by the names of ``keep`` survives. The node is paused, and stays so;
        nothing may be under way to it or from it. A plugin with reset hooks stays loaded, and these
        take the place of its initialise hooks; any other is finalised and loaded anew.

        Raises:
            PluginError, HookError: as :meth:`load`.
            NodeError: if it cannot keep what it is to.
        """
        is_kept = bool(self._resets)
        self.loaded.stop_hooks()
        self._enter()
        if not is_kept:
            self._finalise_hooks()
        self.keeping.begin_anew(keep, forgets=not is_kept)
        if not is_kept:
            self._services.close()
            self.handle.set_user_data(None)
        environment = self._environment(variables)
        forgets = not is_kept and not self.file.node.hooks
        self._contexts.renew(self._context, environment, forgets_modules=forgets)
        self._enter()
        self.time.begin_anew(keeps_owner=is_kept)
        self._services.results.clear()
        self.histories.by_output.clear()
        if is_kept:
            self.specs = [
                replace(spec, kind=HookKind.INITIALISE) if spec.kind is HookKind.RESET else spec
                for spec in self._plugin
                if spec.kind is not HookKind.INITIALISE
            ]
        else:
            self._load_plugin()
        engine = self._make()
        engine.pause()
        self.reports.begin_anew(engine)
        for connection in engine.send_windows:
            engine.on_registered(connection)

    def change(
        self,
        variables: Mapping[str, str],
        parameters: Mapping[str, Any],
        *,
        only_checks: bool = False,
    ) -> None:
        """Change the environment and the parameters, between two hooks; a fault ends the node.

        Args:
            only_checks: whether to check that this is possible, and to change nothing.
        """
        self._enter()
        try:
            if only_checks:
                for _, check in self._services.changes:
                    check(variables)
                return
            self._contexts.change(self._context, variables)
            ros_node = self._middleware.ros_node(self.file)
            for name, value in parameters.items():
                kind = type(ros_node.get_parameter(name))
                (result,) = ros_node.set_parameters([kind(name, value=value)])
                if not result.successful:
                    raise NodeError(f"parameter '{name}' cannot be {value!r}: {result.reason}")
            for apply, _ in self._services.changes:
                apply()
        except BaseException as error:
            known = isinstance(error, NeurosError)
            self.failures.report(error if known else as_node_error(error, "a fork changes it: "))

    def drain(self, last_round: Sequence[int] = (), *, is_asked: bool = False) -> None:
        """Stop the hooks that send unasked; after a pause, the others go on.

        Args:
            last_round: hooks that start at most once more; see :meth:`Engine.drain`.
            is_asked: whether a node has asked for this, at a time of the run's clock.
        """
        drain = partial(self._guard, lambda: self.loaded.drain(last_round))
        if self._virtual is None:
            drain()
        else:
            self._virtual.drain(drain, self.stop, is_asked=is_asked)

    def pause(self) -> None:
        """Start no further hook until :meth:`resume`."""
        self.loaded.pause()

    def resume(self) -> None:
        """Go on after a pause."""
        self._guard(self.loaded.resume)

    def run_for(self, duration_ns: int) -> None:
        """Go on after a pause, in virtual time, and pause again after so long."""
        assert self._virtual is not None
        self.resume()
        self._virtual.after(duration_ns, self.pause)

    def step(self, count: int, *, is_driven: bool) -> None:
        """While paused, let each hook that drives the project start ``count`` times."""
        try:
            self.loaded.step(count, is_driven=is_driven)
        except NeurosError as error:
            self.failures.report(error)

    def stop(self) -> None:
        """Start no further hook. Any thread."""
        self._services.stop()

    def finalise(self, *, runs_hooks: bool = True) -> None:
        """Run the finalise hooks and give up what the plugin holds; each fault is reported."""
        self.stop()
        self._enter()
        if runs_hooks and self.engine is not None:
            self._finalise_hooks(lambda name: self._tell(Finalising(self.name, name)))
            for name in () if self._uninitialised else self.keeping.names:
                self._guard(partial(self.keeping.save, name))
        self._tell(Finalising(self.name, ""))
        if self._is_held and not self._is_local:
            # Leave the newest packets for a session, which may want to see what led to the end.
            packets = {
                f"{self.name}.{output}": (history.count, history.newest(_MOST_SAVED_BYTES))
                for output, history in self.histories.by_output.items()
            }
            with suppress(OSError):  # a full disk is reported by what loses more by it
                (self.run_dir / LAST_PACKETS).write_bytes(to_bytes(AtRest(0, {}, packets)))
        if self._recorder is not None:
            self._recorder.close()
        note_arithmetic(self.run_dir)
        self._services.close()
        self._tell(Finalising(self.name, None))

    # ------------------------------------------------------------------ inbox

    def on_packet(self, connection: Connection, packet: Any) -> None:
        if self._arrivals and (passage := self._arrivals.get(connection)) is not None:
            for observe in passage.observers:
                observe(packet, None)
        try:
            self.loaded.on_packet(connection, packet)
        except NeurosError as error:
            self.failures.report(error)

    def on_external_packet(self, port: Port, packet: Any) -> None:
        for observe in self._heard[port.name].observers:
            observe(packet, None)
        try:
            self.loaded.on_packet(port.name, packet)
        except NeurosError as error:
            self.failures.report(error)

    def deliver(self, input_name: str, data: bytes) -> None:
        """An observer sends a packet to an input of the session.

        What is none is refused in the log: an observer ends no run by a mistake.
        """
        try:
            port = next((p for p in self.file.node.inputs if p.name == input_name), None)
            if port is None or port.external_topic is None:
                text = f"a packet came for '{self.name}.{input_name}', no session's input"
                raise ControlError(text)
            packet = self._middleware.packets.decode(port.type, data)
        except (ControlError, ProtocolError, ValueError) as error:
            self._enter()  # the log is that of its own
            self._logger.warning(f"a packet for input '{input_name}' is refused: {error}")
        else:
            self.on_external_packet(port, packet)

    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None:
        try:
            self.loaded.on_acknowledgement(connection, position, arrival_ns)
        except NeurosError as error:
            self.failures.report(error)

    def on_registered(self, connection: Connection) -> None:
        self._guard(lambda: self.loaded.on_registered(connection))

    def on_timer(self) -> None:
        """The next due time of a hook has come."""
        self._guard(self.loaded.on_timer)

    # ------------------------------------------------------------------ inside

    def _environment(self, variables: Mapping[str, str]) -> dict[str, str]:
        own = {**self.file.node.environment, "NEUROS_RUN_DIR": str(self.run_dir)}
        return {**own, **variables}

    def _enter_callback(self) -> None:
        self._enter()
        if self.engine is not None:
            self.engine.note_callback()

    def _load_plugin(self) -> None:
        node = self.file.node
        for port in (*node.inputs, *node.outputs):  # the plugin may make messages when imported
            self._middleware.packets.packet_class(port.type)
        specs: Sequence[HookSpec] = hook_specs_of(dict(enumerate(node.hooks)))
        if not node.hooks:
            specs = load_plugin(node)
        for spec in specs:
            text, hint = node.misfit(spec.is_batch, bool(spec.inputs or spec.outputs))
            if text:
                raise HookError(f"{text}: {hint}", hook=spec.name, where=spec.where)
        self.specs = self._plugin = with_clocks(node, specs)

    def _make(self) -> Engine:
        node = self.file.node
        packets = self._middleware.packets
        jpegs = {
            c.source_output
            for c in self.file.connections
            if c.is_jpeg and c.source_node == self.name
        }
        types = {
            port.name: PacketType(
                packets.packet_class(port.type),
                packets.checker(port.type, for_jpeg=port.name in jpegs),
            )
            for port in node.outputs
        }
        self.loaded = self.engine = self._services.engine = self._make_engine(
            node, self.file.connections, self.specs, self._effects, self._clock, types
        )
        if self._virtual is not None:
            self._virtual.watch(self.engine.awaited)
        if self._is_held:
            self.engine.pause()
        self.time.clock = self.engine.sim_clock
        self._uninitialised = sum(spec.kind is HookKind.INITIALISE for spec in self.specs)
        return self.engine

    def _on_ready(self) -> None:
        self._restore()
        if self._virtual is not None:
            self._virtual.ready()
        self._tell(Ready(self.name))

    def _on_hook_initialised(self) -> None:
        self._uninitialised -= 1
        self._restore()
        self._on_initialised()

    def _restore(self) -> None:
        """Put what waits into values that were kept, once all initialise hooks have run."""
        if not self._uninitialised:
            self.keeping.restore_waiting()

    def _finalise_hooks(self, begin: Callable[[str], object] = lambda _: None) -> None:
        for spec in self.specs:
            if spec.kind is HookKind.FINALISE:
                begin(spec.name)
                self._guard(partial(self._effects.finalise, spec))

    @property
    def _resets(self) -> list[HookSpec]:
        return [spec for spec in self._plugin if spec.kind is HookKind.RESET]

    def _ask_for_end(self, reason: str, drain_s: float) -> None:
        virtual, request = self._virtual, Shutdown(self.name, reason, drain_s)
        if virtual is None:
            self._tell(request)
            return

        def tell() -> None:
            self._tell(request)

        virtual.post(partial(virtual.end, drain_s, tell))  # at the end of the hook

    def _end_by_duration(self, duration_s: float) -> None:
        self._services.shutdown(f"{duration_s:g} s of simulated time", 5.0)


class NodeEffects:
    """The :class:`~neuros.engine.engine.Effects` of one running node.

    Args:
        contexts, context: the context of the node, and what puts it in place.
        instruments: what looks at packets, in this order.
        on_ready: called once the node waits for all others to become ready.
        on_initialised: called after each initialise hook.
    """

    def __init__(
        self,
        middleware: Middleware,
        file: NodeFile,
        loop: NodeEvents,
        transport: Transport,
        handle: NodeHandle,
        failures: Failures,
        time: SimulatedTime,
        instruments: Sequence[Instrument],
        *,
        contexts: ContextSwitch,
        context: Context,
        on_ready: Callable[[], object],
        on_initialised: Callable[[], None],
    ) -> None:
        self._middleware, self._file = middleware, file
        self._loop, self._copier = loop, middleware.packets.copier
        self._transport = transport
        self._handle = handle
        self._guard = failures.guard
        self.time = time
        # Nothing is to be added to these: each call that is left out counts.
        self.acknowledger = transport.acknowledger
        self.has_taken_in = transport.has_taken_in
        self._note_execution = transport.note_execution
        self.give_way = transport.give_way
        self._instruments = instruments
        self._sent: dict[str, Passage] = {}
        self._passages_to_itself: dict[Connection, Passage] = {}
        self._contexts, self._context = contexts, context
        self.note_ready = on_ready
        self._on_initialised = on_initialised

    def passage(self, way: Way, port: Port, connection: Connection | None = None) -> Passage:
        """A place where packets pass, with the observers of all instruments."""
        passage = Passage(way, port, connection)
        for instrument in self._instruments:
            instrument.attach(passage)
        return passage

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook in the context of its node.

        Raises:
            HookError: if it raises any exception.
        """
        if self._contexts.current is not self._context:
            self._contexts.enter(self._context)
        spec = hook.spec
        try:
            result = spec.function(self._handle, *arguments)
        except HookError:
            raise
        except BaseException as error:
            raise _hook_error(spec, error) from error
        self._note_execution()
        if spec.kind is HookKind.INITIALISE:
            self._on_initialised()
        if self.time.is_watched:
            self.time.update()
        return result

    def finalise(self, spec: HookSpec) -> None:
        """Run a finalise hook.

        Raises:
            HookError: if it raises any exception.
        """
        try:
            spec.function(self._handle)
        except HookError:
            raise
        except BaseException as error:
            raise _hook_error(spec, error) from error

    def sender(self, port: Port, connections: Sequence[Connection]) -> Callable[[Any], None] | None:
        """Return what sends packets of an output, and shows them to the instruments."""
        transmit: Callable[[Any], bytes | None]
        passage = self._sent.get(port.name)
        if passage is None:  # else the node was reset
            passage = self._sent[port.name] = self.passage(Way.SENT, port)
        observed = passage
        if port.external_topic is not None:
            transmit = partial(self._transport.send_external, port)
        elif connections:
            transmit = self._transport.sender(connections)
        elif passage.observers:
            transmit = lambda _: None  # noqa: E731 - of an output that nothing is connected to
        else:
            return None

        def send(packet: Any) -> None:
            data = transmit(packet)
            for observe in observed.observers:
                observe(packet, data)

        return send

    def post(self, event: Callable[[], None]) -> None:
        self._loop.post(partial(self._guard, event))

    def post_loop_back(self, event: Callable[[], None]) -> None:
        self._loop.post_loop_back(partial(self._guard, event))

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        port = self._handle.description.output(connection.source_output)
        passage = self._passages_to_itself.get(connection)
        if passage is None:
            passage = self.passage(Way.TO_ITSELF, port, connection)
            self._passages_to_itself[connection] = passage
        for observe in passage.observers:
            observe(packet, None)
        return self._copier(port.type)(packet)


class VirtualEffects(NodeEffects):
    """The effects of a node in virtual time: before a hook returns, its duration has passed."""

    _hook: Hook
    _durations: Durations | None = None

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook, and hold the node for its duration.

        Raises:
            HookError: as in real time; if it could start for ever at one instant; if the plugin has
                ROS call it, which happens in real time.
        """
        if self._durations is None:
            loop = cast(NodeLoop, self._loop)
            self._durations = Durations(self._file, loop, lambda: self.time.now_s)
            if self._handle.virtual_time is not None:
                self._handle.virtual_time.durations = self._durations
            self._note_execution = self._hold
        self._hook = hook
        self._durations.begin(hook)
        return super().call(hook, arguments)

    def _hold(self) -> None:
        assert self._durations is not None
        self._durations.end(self._hook)
        if self._middleware.has_foreign_entities(self._file):
            raise self._hook.error(
                "the plugin has made a subscription, timer, service or client of ROS, which are"
                " called in real time: use inputs and hooks, or run in real time"
            )


def _hook_error(spec: HookSpec, error: BaseException) -> HookError:
    return HookError(describe(error), hook=spec.name, where=last_line(error, spec.where))
