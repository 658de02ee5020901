"""What the engine of a node does to the world: hooks run, packets leave."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from neuros.core.hook import Hook
from neuros.errors import HookError
from neuros.hooks import HookKind, HookSpec
from neuros.ports import Middleware, Transport, Way
from neuros.project.model import Connection, Port
from neuros.runtime.failures import Failures
from neuros.runtime.handle import NodeHandle
from neuros.runtime.keeper import Keeper
from neuros.runtime.plugin import describe, last_line
from neuros.runtime.sampling import Sampler
from neuros.runtime.simulated_time import SimulatedTime


class NodeEffects:
    """The :class:`~neuros.core.effects.Effects` of one running node.

    Args:
        enter: puts the surroundings of the node in place.
        keeper: where packets go that are recorded, ``None``: none are.
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
        keeper: Keeper | None,
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
        self._keeper = keeper
        self._sampler = sampler
        self._enter = enter
        self._on_first_hook = on_first_hook
        self._on_initialised = on_initialised
        self.has_run = False

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        """Run a hook in the surroundings of its node."""
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
            HookError: if it fails, whatever it raises.
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
        if self._keeper is not None:
            self._keeper.keep(Way.SENT, connections[0].source_output, packet, data)

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on an external topic."""
        if port.name in self._clock_outputs:
            self._time.hear(packet)
        if self._sampler.requests:
            self._sampler.note(port.name, packet)
        self._transport.send_external(port, packet)
        if self._keeper is not None:
            self._keeper.keep(Way.SENT, port.name, packet)

    def post(self, event: Callable[[], None]) -> None:
        """Queue a delivery of the node to itself."""
        self._loop.post(partial(self._guard, event))

    def post_loop_back(self, event: Callable[[], None]) -> None:
        """Queue the loop-back."""
        self._loop.post_loop_back(partial(self._guard, event))

    def copy_to_itself(self, connection: Connection, packet: Any) -> Any:
        """What the node gets on a connection to itself: it shares nothing with this packet."""
        if self._sampler.requests:
            self._sampler.note(connection.source_output, packet)
        if self._keeper is not None:
            self._keeper.keep(Way.TO_ITSELF, str(connection), packet)
        return self._copy(packet)
