"""Takes a part of NeuROS out of a run and puts it back, in turn.

Every Python of the run imports this, since its folder is on the path.

The wall clock is cut into slices, in pairs; in one slice of each pair the part is there, in the
other it is not, for all processes alike. What stays is cut from the source of the methods, so that
nothing is left where something was. The process of the node that owns simulated time writes a line
for each slice: its number, whether the part was there, how many hooks of the node have run, in how
many nanoseconds, and in how many of processor time of the thread.

Environment: ``NEUROS_PART`` (ledger, recording), ``NEUROS_SLICE_NS``, ``NEUROS_SLICES`` (the file).
"""

from __future__ import annotations

import inspect
import os
import random
import sys
import textwrap
import time
from collections.abc import Callable, Mapping
from typing import Any

from neuros.node.node import NodeEffects

Place = tuple[Any, str]


def rewritten(function: Any, changes: Mapping[str, str]) -> Any:
    """A function with some of its text replaced; an empty replacement takes the whole line out."""
    source = textwrap.dedent(inspect.getsource(function))
    for old, new in changes.items():
        assert old in source, f"{function.__qualname__} has no '{old}' any more"
        if new:
            source = source.replace(old, new)
        else:
            source = "\n".join(line for line in source.splitlines() if old not in line)
    scope: dict[str, Any] = {}
    exec(f"from __future__ import annotations\n{source}", function.__globals__, scope)
    return scope[function.__name__]


def nothing(*_: Any) -> None:
    """Stands in for a method that is taken out."""


def without_ledger() -> dict[Place, Any]:
    """Times of packets, digests, the accounts of wall time, the timeline."""
    from neuros.engine.connection_ends import SendWindow, Subscription
    from neuros.engine.engine import Engine
    from neuros.node.simulated_time import SimulatedTime
    from neuros.transport import digests
    from neuros.transport.memory import MemoryTransport

    no_clock = {"self._clock()": "self.since_ns"}
    return {
        (Engine, "_wake"): rewritten(
            Engine._wake, {**no_clock, "self.spent_ns[": "", "self.since_ns = now_ns": "pass"}
        ),
        (Engine, "_run"): rewritten(
            Engine._run, {**no_clock, "self.spent_ns[": "", "hook.busy_ns +=": ""}
        ),
        (Subscription, "consume"): rewritten(
            Subscription.consume, {"self.taken.append": "", "self.taken_ns.append": ""}
        ),
        (SendWindow, "spend"): rewritten(SendWindow.spend, {"self.sent_ns.append": ""}),
        (SimulatedTime, "update"): rewritten(SimulatedTime.update, {"self._timeline.add": ""}),
        (MemoryTransport, "_add_digest"): nothing,
        (digests, "digest_of_bytes"): lambda _: 0,
    }


def without_recording() -> dict[Place, Any]:
    """The event log of the engine, and the packets that are kept."""
    from neuros.engine.engine import Engine
    from neuros.engine.event_log import LoggedEngine
    from neuros.node.instruments import NodeRecorder

    events = [name for name in vars(LoggedEngine) if name in vars(Engine)]
    kept = {"__init__", "__doc__", "__module__", "stop_hooks"}
    plain = {(LoggedEngine, name): getattr(Engine, name) for name in events if name not in kept}
    return {**plain, (NodeRecorder, "keep"): nothing}


PARTS: dict[str, Callable[[], dict[Place, Any]]] = {
    "ledger": without_ledger,
    "recording": without_recording,
}


class Switch:
    """The slices of one process."""

    def __init__(self) -> None:
        self._without = PARTS[os.environ["NEUROS_PART"]]()
        self._with = {place: getattr(*place) for place in self._without}
        self._slice_ns = int(os.environ["NEUROS_SLICE_NS"])
        self._file = open(os.environ["NEUROS_SLICES"], "a", buffering=1)  # noqa: SIM115
        self._slice = self._end_ns = self._begun_ns = self._worked_ns = self._runs = 0
        self._is_whole = True

    def look(self, is_counted: bool) -> None:
        """A hook starts."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._end_ns:
            if self._runs:
                took_ns, worked_ns = (
                    now_ns - self._begun_ns,
                    time.thread_time_ns() - self._worked_ns,
                )
                row = (self._slice, int(self._is_whole), self._runs, took_ns, worked_ns)
                self._file.write(" ".join(map(str, row)) + "\n")
            self._turn(now_ns)
        self._runs += is_counted

    def _turn(self, now_ns: int) -> None:
        self._slice = now_ns // self._slice_ns
        self._end_ns = (self._slice + 1) * self._slice_ns
        pair, place = divmod(self._slice, 2)
        is_whole = bool(random.Random(pair).getrandbits(1) ^ place)
        if is_whole != self._is_whole:
            self._is_whole = is_whole
            for (owner, name), value in (self._with if is_whole else self._without).items():
                setattr(owner, name, value)
        self._runs = 0
        self._begun_ns, self._worked_ns = time.monotonic_ns(), time.thread_time_ns()


def install() -> None:
    """Have every hook of this process look at its switch first."""
    switches: list[Switch] = []
    call = NodeEffects.call

    def looking(self: Any, hook: Any, arguments: Any) -> Any:
        if not switches:
            switches.append(Switch())
        switches[0].look(self._time.is_watched)
        return call(self, hook, arguments)

    NodeEffects.call = looking  # type: ignore[method-assign]


if "NEUROS_PART" in os.environ and "neuros.cli.main" not in sys.modules:
    install()
