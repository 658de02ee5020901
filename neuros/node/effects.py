"""Effects of the engine of a node: it runs hooks, sends packets and shows them to instruments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from neuros.engine.hook import Hook
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec
from neuros.node.failures import Failures
from neuros.node.handle import NodeHandle
from neuros.node.instruments import Instrument, Tap
from neuros.node.plugin import describe, last_line
from neuros.node.simulated_time import SimulatedTime
from neuros.ports import Middleware, Transport, Way
from neuros.project.model import Connection, Port


class NodeEffects:
    """The :class:`~neuros.engine.engine.Effects` of one running node.

    Args:
        enter: puts the context of the node in place.
        instruments: what looks at packets, in this order.
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
        instruments: Sequence[Instrument],
        *,
        enter: Callable[[], None],
        on_first_hook: Callable[[], object],
        on_initialised: Callable[[], None],
    ) -> None:
        self._loop, self._copy = middleware.loop, middleware.packets.copy
        self._transport = transport
        self._handle = handle
        self._guard = failures.guard
        self._time = time
        # Nothing is to be added to these: each call that is left out counts.
        self.acknowledger = transport.acknowledger
        self.has_taken_in = transport.has_taken_in
        self._note_execution = transport.note_execution
        self.give_way = transport.give_way
        self._instruments = instruments
        self._sent: dict[str, Tap] = {}
        self._taps_to_itself: dict[Connection, Tap] = {}
        self._enter = enter
        self._on_first_hook = on_first_hook
        self._on_initialised = on_initialised
        self.has_run = False

    def tap(self, way: Way, port: Port, connection: Connection | None = None) -> Tap:
        """A place where packets pass, with the instruments that want to look at them."""
        tap = Tap(way, port, connection)
        for instrument in self._instruments:
            instrument.attach(tap)
        return tap

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook in the context of its node.

        Raises:
            HookError: if it raises any exception.
        """
        self._enter()
        if not self.has_run:
            self.has_run = True
            self._on_first_hook()
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
        if self._time.is_watched:
            self._time.look()
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
        tap = self._sent.get(port.name)
        if tap is None:  # else the node was reset
            tap = self._sent[port.name] = self.tap(Way.SENT, port)
        observed = tap
        if port.external_topic is not None:
            transmit = partial(self._transport.send_external, port)
        elif connections:
            transmit = self._transport.sender(connections)
        elif tap.observers:
            transmit = _to_nobody
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
        tap = self._taps_to_itself.get(connection)
        if tap is None:
            port = self._handle.description.output(connection.source_output)
            tap = self._taps_to_itself[connection] = self.tap(Way.TO_ITSELF, port, connection)
        for observe in tap.observers:
            observe(packet, None)
        return self._copy(packet)


def _to_nobody(packet: Any) -> None:
    """Send a packet of an output that nothing is connected to."""


def _hook_error(spec: HookSpec, error: BaseException) -> HookError:
    return HookError(describe(error), hook=spec.name, where=last_line(error, spec.where))
