"""Effects of the engine of a node: it runs hooks, sends packets and records them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from neuros.engine.hook import Hook
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec
from neuros.node.failures import Failures
from neuros.node.handle import NodeHandle
from neuros.node.plugin import describe, last_line
from neuros.node.sampling import Sampler
from neuros.node.simulated_time import SimulatedTime
from neuros.ports import Logger, Middleware, PacketRecorder, Transport, Way
from neuros.project.model import Connection, Port


class NodeEffects:
    """The :class:`~neuros.engine.engine.Effects` of one running node.

    Args:
        enter: puts the context of the node in place.
        recorder: where packets go that are recorded, ``None``: none are.
        sampler: looks at packets for observers.
        on_first_hook: called before the first hook.
        on_initialised: called after each initialise hook.

    Attributes:
        has_run: whether a hook has started.
    """

    def __init__(
        self,
        middleware: Middleware,
        transport: Transport,
        handle: NodeHandle,
        failures: Failures,
        time: SimulatedTime,
        recorder: NodeRecorder | None,
        sampler: Sampler,
        *,
        enter: Callable[[], None],
        on_first_hook: Callable[[], object],
        on_initialised: Callable[[], None],
    ) -> None:
        self._loop, self._copy = middleware.loop, middleware.copy
        self._transport = transport
        self._handle = handle
        self._guard = failures.guard
        self._time = time
        self._clock_outputs = time.clock_outputs
        # Nothing is to be added to these: each call that is left out counts.
        self.acknowledge = transport.acknowledge
        self.has_taken_in = transport.has_taken_in
        self._note_execution = transport.note_execution
        self._recorder = recorder
        self._sampler = sampler
        self._enter = enter
        self._on_first_hook = on_first_hook
        self._on_initialised = on_initialised
        self.has_run = False

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook in the context of its node."""
        self._enter()
        if not self.has_run:
            self.has_run = True
            self._on_first_hook()
        box = [self.run(hook.spec, arguments)]
        self._note_execution()
        del arguments  # else a packet that the hook passes on would count as held
        if hook.spec.kind is HookKind.INITIALISE:
            self._on_initialised()
        if hook.outputs:
            self._transport.note_result(box)
        if self._time.is_watched:
            self._time.look()
        return box[0]

    def run(self, spec: HookSpec, arguments: Sequence[Any] = ()) -> Any:
        """Run the function of a hook.

        Raises:
            HookError: if it raises any exception.
        """
        try:
            return spec.function(self._handle, *arguments)
        except HookError:
            raise
        except BaseException as error:
            where = last_line(error, spec.where)
            raise HookError(describe(error), hook=spec.name, where=where) from error

    def send(self, connections: Sequence[Connection], packet: Any) -> None:
        """Send on connections to other nodes."""
        if self._clock_outputs and connections[0].source_output in self._clock_outputs:
            self._time.hear(packet)
        if self._sampler.requests:
            self._sampler.note(connections[0].source_output, packet)
        data = self._transport.send(connections, packet)
        if self._recorder is not None:
            self._recorder.keep(Way.SENT, connections[0].source_output, packet, data)

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on an external topic."""
        if port.name in self._clock_outputs:
            self._time.hear(packet)
        if self._sampler.requests:
            self._sampler.note(port.name, packet)
        self._transport.send_external(port, packet)
        if self._recorder is not None:
            self._recorder.keep(Way.SENT, port.name, packet)

    def post(self, event: Callable[[], None]) -> None:
        """Queue a delivery of the node to itself."""
        self._loop.post(partial(self._guard, event))

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Queue the loop-back."""
        self._loop.post_loop_back(partial(self._guard, event))

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        """A copy for a connection of the node to itself; it shares nothing with this packet."""
        if self._sampler.requests:
            self._sampler.note(connection.source_output, packet)
        if self._recorder is not None:
            self._recorder.keep(Way.TO_ITSELF, str(connection), packet)
        return self._copy(packet)


class NodeRecorder:
    """Gives packets of one node, serialised, to its packet recorder, until that fails.

    Args:
        encode: serialises a packet.
        time: that of the node, if it has one.
    """

    def __init__(
        self,
        recorder: PacketRecorder,
        encode: Callable[[Any], bytes],
        time: SimulatedTime,
        logger: Logger,
    ) -> None:
        self._recorder: PacketRecorder | None = recorder
        self._encode = encode
        self._time = time
        self._logger = logger

    def wanted_on_arrival(self, connections: Iterable[Connection]) -> frozenset[Connection]:
        """Connections whose packets are kept where they arrive: their senders are elsewhere."""
        recorder = self._recorder
        if recorder is None:
            return frozenset()
        return frozenset(
            c for c in connections if recorder.stream(Way.RECEIVED, str(c)) is not None
        )

    def keep(self, way: Way, name: str, packet: Any, data: bytes | None = None) -> None:
        """Record a packet, where that is wanted; ``data`` is the packet, if serialised already."""
        recorder = self._recorder
        if recorder is None or (stream := recorder.stream(way, name)) is None:
            return
        try:
            recorder.keep(stream, data or self._encode(packet), self._time.now_s)
        except OSError as error:
            self.close()
            self._logger.error(
                f"its packets are not recorded from now on: {error.strerror}; the run goes on"
            )

    def close(self) -> None:
        """Record nothing any more."""
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None
