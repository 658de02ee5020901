"""Reports of a node: its state and counters for the supervisor, its status for observers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import neuros.control as control
from neuros.engine.engine import Engine
from neuros.engine.metrics import State
from neuros.engine.snapshot import explain, snapshot, steadily
from neuros.hooks import HookKind, HookSpec
from neuros.node.instruments import NodeRecorder
from neuros.node.logs import PacketLog, WorldLog
from neuros.node.sampling import Sampler
from neuros.node.simulated_time import SimulatedTime
from neuros.ports import Logger, Middleware, NodeLoop, Transport, WorldLook
from neuros.project.model import Connection, NodeFile
from neuros.project.names import SESSION
from neuros.project.timing import VIRTUAL
from neuros.stacks import LONG_S, Stack, stack_in

_MAIN = threading.main_thread()
_LAST_SENT = 16


@dataclass
class NodeReports:
    """State and counters of one running node; ``_clock`` is monotonic, in nanoseconds."""

    _file: NodeFile
    _middleware: Middleware
    _transport: Transport
    _time: SimulatedTime
    _sampler: Sampler
    _clock: Callable[[], int]
    _recorder: NodeRecorder | None = None
    _world_log: WorldLog | None = None
    _keeps: Callable[[], tuple[str, ...]] = tuple
    _engine: Engine | None = None
    _packet_log: PacketLog | None = None
    _has_begun: bool = False

    def open(self, engine: Engine, logger: Logger) -> None:
        """There is an engine to report of; what is special about it is logged."""
        self._engine = engine
        folder = self._file.folders.run / self._file.node.name
        self._packet_log = PacketLog(engine, self._transport.digests, folder, self._file.list_bytes)
        for hook in engine.free_running_hooks():
            logger.info(f"hook '{hook.name}' requires no input: it runs without pause")
        for subscription in engine.untaken_subscriptions():
            if subscription.name.startswith(SESSION):
                continue
            logger.warning(
                f"no hook takes input '{subscription.input_name}': packets on"
                f" {subscription.name} are acknowledged on arrival and dropped"
            )

    def begin(self) -> None:
        """The node may start hooks: from now on there is something to report."""
        self._has_begun = True

    def begin_anew(self, engine: Engine) -> None:
        self._engine = engine
        if self._packet_log is not None:
            self._packet_log.begin_anew(engine)

    def show_world(self, look: WorldLook) -> None:
        """Let observers look at the simulated world of the node, and the recording, if any."""
        self._sampler.look_at_world = look
        if self._world_log is not None:
            self._world_log.write(look)

    def write_logs(self) -> None:
        """Write out when packets were sent and taken, and how the world has moved. Any thread."""
        if self._packet_log is not None:
            self._packet_log.write()
        if self._world_log is not None and self._sampler.look_at_world is not None:
            self._world_log.write(self._sampler.look_at_world)

    def report(self, *, is_final: bool = False) -> control.Report:
        """State and counters. Any thread."""
        return control.Report(**self._state(), is_final=is_final)

    def _state(self) -> dict[str, Any]:
        now_ns, engine = self._clock(), self._engine
        metrics: dict[str, Any] | None = None
        reasons: tuple[str, ...] = ()
        stack: Stack | None = None
        if engine and self._has_begun:
            metrics = snapshot(engine, now_ns)
            executing = metrics["executing"]
            reasons = () if executing else tuple(explain(engine, now_ns))
            if reasons and (waits := self._middleware.loop_of(self._file).waits_for):
                reasons = (waits,)
            is_long = engine.is_stopped or (executing and executing["for_s"] >= LONG_S)
            if is_long and threading.current_thread() is not _MAIN:  # which is between two hooks
                stack = stack_in(self._file.node.name, self._file.node.plugin)
        return {
            "node": self._file.node.name,
            "waiting_for": tuple(str(each) for each in self._transport.waiting_for()),
            **self._time.report(now_ns),
            "running_since_s": engine.tick_start_ns / 1e9 if engine and engine.is_running else None,
            "metrics": metrics,
            "reasons": reasons,
            "stack": stack,
            "fault": self._fault,
            "compressed": self._transport.compressed,
            "is_driving": engine is not None and engine.is_driving,
            "virtual_s": now_ns / 1e9 if self._file.time == VIRTUAL else None,
        }

    @property
    def _fault(self) -> str | None:
        """What cannot be recorded: where a disk is full, one sentence of each node is enough."""
        if self._packet_log is not None and self._packet_log.failure is not None:
            return self._packet_log.failure
        for part in (self._recorder, self._world_log):
            if part is not None and part.failure is not None:
                return f"node '{self._file.node.name}': {part.failure}"
        return None

    def status(self, wanted: Mapping[str, Mapping[str, Any]], asker: int) -> control.NodeStatus:
        """What an observer is shown: the node, and what was sampled of its packets. Any thread.

        Args:
            wanted: what to sample for the next time (see :class:`Sampler`).
            asker: the number of the observer.
        """
        engine = self._engine
        return control.NodeStatus(
            self._file.node.name,
            asker,
            self._time.now_s,
            None if engine is None else live_counters(engine, self._clock()),
            self._sampler.ask(wanted, asker),
            self._keeps(),
        )

    def probe(self, *, is_idle: bool, has_free_threads: bool) -> control.NodeProbe:
        """Where the node stands between two events. Loop thread only.

        A thread of a plugin may submit packets, or end the project, at any time.
        """
        engine = self._engine
        assert engine is not None
        rest = engine.rest()
        is_wakeable = (
            has_free_threads
            or engine.is_wakeable
            or (not engine.is_stopped and self._middleware.has_foreign_entities(self._file))
        )
        at_rest = self.probe_at_rest(())
        return control.NodeProbe(
            sent=at_rest.sent,
            received=at_rest.received,
            sim_time=at_rest.sim_time,
            is_active=at_rest.is_active,
            unread=frozenset(s.name for s in engine.subscriptions.values() if s.unread),
            executions=sum(hook.executions for hook in engine.all_hooks),
            lacks=rest.cause if rest.state is State.WAITING else "",
            is_startable=engine.has_startable_packet,
            is_wakeable=is_wakeable,
            is_idle=is_idle,
            virtual_ns=at_rest.virtual_ns,
        )

    def probe_at_rest(self, here: Container[str]) -> control.NodeProbe:
        """Where the node stands at the end of a step, when no event waits. Loop thread only.

        Connections with the nodes ``here`` are left out: nothing is under way on them then.
        """
        engine = self._engine
        assert engine is not None
        loop = self._middleware.loop_of(self._file)
        lost = cast(NodeLoop, loop).lost if self._file.time == VIRTUAL else lambda _: 0
        return control.NodeProbe(
            sent={
                str(window.connection): (window.sent - lost(window.connection), window.acknowledged)
                for window in engine.send_windows.values()
                if window.connection.destination_node not in here
            },
            received={
                each.name: (each.received, each.acknowledged)
                for each in engine.subscriptions.values()
                if isinstance(each.key, Connection) and each.key.source_node not in here
            },
            sim_time=self._time.now_s,
            is_active=engine.is_active,
            virtual_ns=self._clock() if self._file.time == VIRTUAL else None,
        )


def declared(node: str, specs: Sequence[HookSpec]) -> control.Hooks:
    """The hooks of a node, as the supervisor needs them."""
    return control.Hooks(
        node,
        tuple(
            control.HookDeclaration(
                spec.kind, spec.inputs, tuple(port.name for port in spec.outputs)
            )
            for spec in specs
            if spec.is_scheduled
        ),
        tuple(spec.name for spec in specs if spec.kind is HookKind.FINALISE),
    )


def live_counters(engine: Engine, now_ns: int) -> control.LiveCounters:
    """Counters and latest times of a node. Any thread.

    Times lack the connections whose packet log has just been written out.
    """
    metrics = snapshot(engine, now_ns)
    for hook in metrics["hooks"].values():
        for figure in hook.keys() - {"executions", "busy_s"}:
            del hook[figure]
    no_sent: dict[str, tuple[int, tuple[int, ...]]] = {}
    no_taken: dict[str, tuple[int, int]] = {}
    return control.LiveCounters(
        now_ns / 1e9,
        cast(control.Metrics, metrics),
        steadily(lambda: _sent(engine), no_sent),
        steadily(lambda: _taken(engine), no_taken),
        steadily(lambda: tuple(engine.pauses.last_still_ns), ()),
    )


def _sent(engine: Engine) -> dict[str, tuple[int, tuple[int, ...]]]:
    return {
        str(window.connection): (window.sent, tuple(window.sent_ns[-_LAST_SENT:]))
        for window in engine.send_windows.values()
        if window.is_reliable and window.sent_ns
    }


def _taken(engine: Engine) -> dict[str, tuple[int, int]]:
    found: dict[str, tuple[int, int]] = {}
    for key, subscription in engine.subscriptions.items():
        count = min(len(subscription.taken), len(subscription.taken_ns))
        if isinstance(key, Connection) and count:
            found[str(key)] = subscription.taken[count - 1], subscription.taken_ns[count - 1]
    return found
