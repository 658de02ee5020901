"""Simulated time of a node: its source, its points in wall time, and the end of its duration."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from neuros.engine.sim_clock import SimClock
from neuros.node.instruments import Passage
from neuros.ports import Way
from neuros.project.model import CLOCK_TYPE, Node
from neuros.time import to_seconds, to_stamp

_FINE_S = 60.0
_FINE_INTERVAL_S = 0.1


class SimulatedTime:
    """The time of a simulator that the node owns, or else of a clock that it publishes.

    Args:
        duration_s: when a node that owns time ends the project, ``None``: never.
        clock: monotonic clock in nanoseconds.
        wall_ns: nanoseconds since 1970; in virtual time since time 0.
        on_over: called once with the duration when it has passed.

    Attributes:
        is_watched: whether the node owns time, so that :meth:`look` is wanted after each hook.
        expected_end_s: when the plugin says that it will end the project, ``None``: not known.
        clock: that of the node's engine, which tells the time of other nodes.
        read_s: reads the simulated seconds of what the node owns, ``None`` where they are unknown.
    """

    def __init__(
        self,
        node: Node,
        duration_s: float | None,
        clock: Callable[[], int],
        on_over: Callable[[float], None],
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.is_watched = node.owns_time
        self._is_owned = False
        self.expected_end_s: float | None = None
        self._duration_s = duration_s if node.owns_time else None
        self._has_told = False
        self._clock = clock
        self._wall_ns = wall_ns
        self._on_over = on_over
        self._timeline = Timeline()
        self.read_s: Callable[[], float] | None = None
        self._has_clock = node.clock is not None
        self.clock = SimClock()

    @property
    def now_s(self) -> float | None:
        """Simulated seconds of what the node owns, ``None`` where they are unknown."""
        return None if self.read_s is None else self.read_s()

    @property
    def known_s(self) -> float | None:
        """Simulated seconds as far as the node knows: of what it owns, or else of its clock."""
        if self.read_s is not None:
            return self.read_s()
        return None if self.clock.now_ns is None else self.clock.now_ns / 1e9

    def stamp(self, reading: Callable[[int], int]) -> Any:
        """A stamp of now: simulated where the node owns time or has a clock, else wall time.

        Args:
            reading: what is read of the wall clock, by what it says (:meth:`Engine.reading`).
        """
        if self.read_s is not None:
            return to_stamp(self.read_s())
        if self._has_clock or self.is_watched:
            return to_stamp(nanoseconds=self.clock.now_ns or 0)
        return to_stamp(nanoseconds=reading(self._wall_ns()))

    def begin_anew(self, *, keeps_owner: bool) -> None:
        """The node was reset; ``keeps_owner``: the simulator that has the time goes on."""
        if not (keeps_owner and self._is_owned):
            self.read_s, self._is_owned = None, False
        self.expected_end_s = None
        self._timeline = Timeline()

    def own(self, read_s: Callable[[], float]) -> None:
        """Read the time from a simulator, not from a clock that the node publishes."""
        self.read_s = read_s
        self._is_owned = True

    def attach(self, passage: Passage) -> None:
        """Read the time from clocks that the node publishes."""
        if passage.way is Way.SENT and passage.port.type == CLOCK_TYPE:
            passage.add(self._on_clock)

    def _on_clock(self, packet: Any, _: bytes | None) -> None:
        if self._is_owned:
            return
        seconds = to_seconds(packet)
        self.read_s = lambda: seconds
        if self.is_watched:
            self.update()

    @property
    def is_over(self) -> bool:
        """Whether the duration has passed. Any thread."""
        if self._duration_s is None or (time_s := self.now_s) is None:
            return False
        return time_s >= self._duration_s - 1e-9

    def update(self) -> None:
        """It may have gone on; it may be over."""
        if self.read_s is None:
            return
        time_s = self.read_s()
        self._timeline.add(time_s, self._clock() / 1e9)
        if self._duration_s is not None and self.is_over and not self._has_told:
            self._has_told = True
            self._on_over(self._duration_s)

    def report(self, now_ns: int) -> dict[str, Any]:
        """The time, and the points ``(simulated, wall)`` since this was last asked. Any thread."""
        time_s = self.now_s
        if self.is_watched and time_s is not None:
            self._timeline.add(time_s, now_ns / 1e9)
        return {
            "sim_time": time_s,
            "expected_end_s": self.expected_end_s,
            "timeline": self._timeline.pop(),
        }


class Timeline:
    """Collects points of simulated and wall time until :meth:`pop`. Any thread.

    Two threads that note one second at one moment may leave it there twice.
    """

    def __init__(self) -> None:
        self._next_s = 0.0
        self._next_wall_s = -math.inf
        self._fine_until_s: float | None = None
        self._last = (-math.inf, -math.inf)
        self._points: list[tuple[float, float]] = []

    def add(self, sim_s: float, wall_s: float) -> None:
        """It is ``sim_s`` now; the first reading in each simulated second is kept.

        Where time goes back, since a simulator was reset, so are the last reading and the new one.

        In the first minute there is a reading each tenth of a second besides: the other nodes
        initialise then, and the real-time factor begins when the last one has.
        """
        if self._fine_until_s is None:
            self._fine_until_s = wall_s + _FINE_S
        if sim_s < self._last[0]:
            self._points.append(self._last)
            self._next_s = sim_s
        self._last = (sim_s, wall_s)
        if sim_s >= self._next_s or self._next_wall_s <= wall_s < self._fine_until_s:
            self._next_s = math.floor(sim_s) + 1.0
            self._next_wall_s = wall_s + _FINE_INTERVAL_S
            self._points.append((sim_s, wall_s))

    def pop(self) -> list[tuple[float, float]]:
        """The points ``(simulated, wall)`` since this was last asked."""
        count = len(self._points)
        taken = self._points[:count]
        del self._points[:count]
        return taken
