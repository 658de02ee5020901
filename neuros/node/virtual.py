"""A node in virtual time: its hooks take declared durations, its simulator steps by events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from neuros.engine.hook import Hook
from neuros.errors import NodeError
from neuros.hooks import HookKind
from neuros.project.timing import Draws

if TYPE_CHECKING:
    from neuros.engine.engine import Engine
    from neuros.node.failures import Failures
    from neuros.ports import NodeLoop
    from neuros.project.model import NodeFile

_MOST_STARTS = 100_000
"""Of the hooks of a node at one instant; more are an endless loop."""


class Durations:
    """How long the executions of a node's hooks take.

    Args:
        loop: of the node.
        sim_time_s: simulated seconds of the node's simulator; ``None``: it has none.
    """

    def __init__(
        self, file: NodeFile, loop: NodeLoop, sim_time_s: Callable[[], float | None]
    ) -> None:
        self._node = file.node
        self._loop = loop
        self._sim_time_s = sim_time_s
        self._since_ns = 0
        self._draws: dict[Hook, Draws] = {}
        self._declared_ns: int | None = None
        self._stepped_ns = 0

    def begin(self, hook: Hook) -> None:
        """A hook starts."""
        self._since_ns = self._sim_ns()
        self._declared_ns, self._stepped_ns = None, 0
        if hook.spec.kind is HookKind.INITIALISE:
            return
        duration = self._node.durations.get(hook.name)
        if duration is not None:
            draws = self._draws.get(hook)
            if draws is None:
                draws = Draws(self._loop.seed, "hook", self._node.name, hook.name)
                self._draws[hook] = draws
            is_constant = duration.kind == "constant"
            share = 0.5 if is_constant else draws.share(hook.executions + 1)
            self._declared_ns = duration.at_ns(share)
        self._loop.announce(self._declared_ns or 0)

    def will_step_to(self, sim_time_s: float) -> None:
        """The hook steps the simulator so far: nodes that wait for this one may go on."""
        if self._declared_ns is None:
            self._stepped_ns = max(self._stepped_ns, round(sim_time_s * 1e9) - self._since_ns)
            self._loop.announce(self._stepped_ns)

    def end(self, hook: Hook) -> None:
        """The function of the hook has returned: the node is held for the duration.

        Raises:
            HookError: if hooks could start at this instant for ever.
        """
        if hook.spec.kind is HookKind.INITIALISE:
            return
        duration_ns = self._declared_ns
        if duration_ns is None:
            # What was announced stands, also if the hook resets the simulator afterwards.
            duration_ns = max(self._stepped_ns, self._sim_ns() - self._since_ns)
            if not duration_ns and hook.drives and hook.spec.kind is HookKind.FUNCTION:
                raise hook.error(": ".join(self._node.timeless(hook.name)))
        self._loop.hold(duration_ns)
        if self._loop.starts > _MOST_STARTS:
            raise hook.error(
                f"hooks of node '{self._node.name}' have started {_MOST_STARTS} times at one"
                ' instant of virtual time: give one of them a duration, "durations": {"'
                f'{hook.name}": 0.01}}'
            )

    def _sim_ns(self) -> int:
        return round((self._sim_time_s() or 0.0) * 1e9)


class VirtualTime:
    """The virtual clock for what a node does by itself, such as a simulator that steps itself.

    Args:
        engine: the node's, of now.
        failures: reports errors of events.

    Attributes:
        durations: of the hooks, once one has run.
    """

    def __init__(self, loop: NodeLoop, engine: Callable[[], Engine], failures: Failures) -> None:
        self._loop = loop
        self._engine = engine
        self._failures = failures
        self._waiting: list[Callable[[], None]] = []
        self._is_active = False
        self.durations: Durations | None = None

    def clock_s(self) -> float:
        """Seconds since time 0 of the run."""
        return (self._loop.clock() - self._loop.zero_ns) / 1e9

    def when_active(self, event: Callable[[], None]) -> None:
        """Call ``event`` at time 0 of the run, or now if that has passed."""
        if self._is_active:
            self._loop.at(0, partial(self._guard, event))
        else:
            self._waiting.append(event)

    def activate(self) -> None:
        """Time 0 of the run has come."""
        self._is_active = True
        self._loop.begin()
        waiting, self._waiting = self._waiting, []
        for event in waiting:
            self.when_active(event)

    def call_at(self, time_s: float, event: Callable[[], None]) -> None:
        """Call ``event`` so many seconds after time 0, or now if that has passed."""
        self._loop.at(self._loop.zero_ns + round(time_s * 1e9), partial(self._guard, event))

    def will_step_to(self, sim_time_s: float) -> None:
        """The hook that runs steps the simulator so far, which will be the end of the hook."""
        if self.durations is not None:
            self.durations.will_step_to(sim_time_s)

    def send(self, packets: Mapping[str, Any], sent: Callable[[], None]) -> None:
        """Send packets, by output, as soon as a hook could; then call ``sent``."""
        self._engine().offer(packets, sent)

    def _guard(self, event: Callable[[], None]) -> None:
        try:
            event()
        except Exception as error:
            self._failures.report(error)


def refuse_thread(node: str, what: str) -> NodeError:
    """The error of a plugin that sends from a thread, whose pace virtual time does not know."""
    return NodeError(
        f"{what}: node '{node}' sends from a thread of its plugin, which takes real time: let a"
        " tick or function hook send, or run in real time"
    )
