"""Simulated time against wall time, once per simulated second."""

from __future__ import annotations

import math


class Timeline:
    """Collects points until somebody takes them. Any thread.

    Two threads that note the same second at the same moment may leave it there twice.
    """

    def __init__(self) -> None:
        self._next_s = 0.0
        self._points: list[tuple[float, float]] = []

    def note(self, sim_s: float, wall_s: float) -> None:
        """It is ``sim_s`` now; the first reading in each simulated second is kept."""
        if sim_s >= self._next_s:
            self._next_s = math.floor(sim_s) + 1.0
            self._points.append((sim_s, wall_s))

    def take(self) -> list[tuple[float, float]]:
        """The points ``(simulated, wall)`` since this was last asked."""
        count = len(self._points)
        taken = self._points[:count]
        del self._points[:count]
        return taken
