"""Simulated time against the wall clock."""

from __future__ import annotations

from collections.abc import Callable

_MAX_LAG_S = 0.5


class Pacer:
    """Holds a simulation back to ``factor`` simulated seconds per wall second.

    It measures against a fixed origin, so errors of single waits do not add up: after a late wait
    the simulation catches up. What it is behind by more than ``max_lag_s`` it gives up for good,
    so that it does not race after a long stall. ``factor`` ``None`` never waits.
    """

    def __init__(
        self,
        factor: float | None,
        clock: Callable[[], float],
        wait: Callable[[float], object],
        max_lag_s: float = _MAX_LAG_S,
    ) -> None:
        self._factor, self._clock, self._wait, self._max_lag_s = factor, clock, wait, max_lag_s
        self._origin: float | None = None

    def restart(self) -> None:
        """Forget the past: the next call sets a new origin. For pauses and resets; any thread."""
        self._origin = None

    def start(self, sim_time_s: float) -> None:
        """Now is when ``sim_time_s`` should be."""
        if self._factor is not None:
            self._origin = self._clock() - sim_time_s / self._factor

    def hold(self, sim_time_s: float) -> None:
        """Wait until ``sim_time_s`` may be."""
        if self._factor is None:
            return
        origin = self._origin  # read once: another thread may call restart
        if origin is None:
            self.start(sim_time_s)
            return
        early_s = origin + sim_time_s / self._factor - self._clock()
        if early_s > 0:
            self._wait(early_s)
        elif -early_s > self._max_lag_s:
            self._origin = origin - early_s - self._max_lag_s
