"""Progress of a run in one line, from the reports that nodes make once per second.

Standard library and ``tqdm``, which lays out the bar; nothing here writes or waits.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

from neuros.control import Report

_WINDOW_S = 5.0
"""Rates are those of the last few reports, not of the whole run."""
_BESIDE_TEXT = 18
"""Columns: the percentage, and a bar that can be seen."""


class Reported(Protocol):
    """Reports of a run that goes on."""

    @property
    def reports(self) -> Mapping[str, Report]: ...
    @property
    def started_s(self) -> float | None: ...
    @property
    def paused_s(self) -> float: ...
    @property
    def is_paused(self) -> bool: ...


class _Reading(NamedTuple):
    """``wall_s`` is without pauses."""

    wall_s: float
    sim_s: float | None
    sent: int
    discarded: int


class Progress:
    """Reads the reports of a run.

    Args:
        outcome: where they are.
        wall_s, sim_s: how long the run is to last, as far as that is known: a node may tell it
            (``node.expect_end``).
        clock: monotonic, seconds.
    """

    def __init__(
        self,
        outcome: Reported,
        wall_s: float | None = None,
        sim_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._outcome = outcome
        self._wall_s = wall_s
        self._sim_s = sim_s
        self._clock = clock
        self._readings: deque[_Reading] = deque()

    @property
    def has_end(self) -> bool:
        """Whether it is known when the run ends."""
        return self._wall_s is not None or self._end_sim_s is not None

    def text(self) -> str:
        """Everything in words; empty before the first hook has started."""
        now = self._read()
        return "" if now is None else ", ".join([self._how_far(now), *self._figures(now)])

    def bar(self, columns: int, *, is_ascii: bool) -> str:
        """The line with a bar, where an end is known; never wider than a terminal."""
        from tqdm.std import tqdm

        now = self._read()
        if now is None:
            return ""
        share = self._share(now)
        parts = [self._how_far(now), *self._figures(now)]
        if share is None:
            return ", ".join(parts)[: columns - 1]
        while len(parts) > 2 and len(", ".join(parts)) > columns - _BESIDE_TEXT:
            del parts[-2]  # the last is the time that is left
        text = ", ".join(parts)
        # What tqdm makes of n and total is a bar and a percentage; the rest is ours.
        layout = "{percentage:3.0f}%|{bar}| " + text
        line: str = tqdm.format_meter(
            share, 1.0, 1.0, ncols=columns - 1, bar_format=layout, ascii=is_ascii
        )
        return line[: columns - 1]

    @property
    def _end_sim_s(self) -> float | None:
        if self._sim_s is not None:
            return self._sim_s
        ends = [r.expected_end_s for r in self._outcome.reports.values()]
        return max((end for end in ends if end is not None), default=None)

    def _read(self) -> _Reading | None:
        """What the reports say now, and kept for the rates."""
        if self._outcome.started_s is None:
            return None
        reports = self._outcome.reports.values()
        times = [r.sim_time for r in reports if r.sim_time is not None]
        all_metrics = [r.metrics for r in reports if r.metrics is not None]
        reading = _Reading(
            self._clock() - self._outcome.paused_s,
            max(times, default=None),
            sum(c["sent"] for metrics in all_metrics for c in metrics["outgoing"].values()),
            sum(c["discarded"] for metrics in all_metrics for c in metrics["incoming"].values()),
        )
        if not self._readings or self._readings[-1][1:] != reading[1:]:
            self._readings.append(reading)
        while len(self._readings) > 2 and reading.wall_s - self._readings[0].wall_s > _WINDOW_S:
            self._readings.popleft()
        return reading

    def _how_far(self, now: _Reading) -> str:
        end_s = self._end_sim_s
        if now.sim_s is not None:
            of = "" if end_s is None or self._wall_s is not None else f" of {end_s:g}"
            return f"{now.sim_s:.1f}{of} s simulated"
        of = "" if self._wall_s is None else f" of {self._wall_s:g}"
        return f"{min(self._elapsed_s(now), self._wall_s or math.inf):.0f}{of} s"

    def _figures(self, now: _Reading) -> list[str]:
        first = self._readings[0]
        passed_s = self._readings[-1].wall_s - first.wall_s
        figures = []
        factor = None
        if passed_s > 0:
            if now.sim_s is not None and first.sim_s is not None:
                factor = (now.sim_s - first.sim_s) / passed_s
                figures.append(f"{factor:.2f} x real time")
            figures.append(f"{(now.sent - first.sent) / passed_s:.0f} packets/s")
        if self._outcome.is_paused:
            figures = ["paused"]
        figures.append(f"{now.discarded} discarded")
        left_s = self._left_s(now, factor)
        return figures if left_s is None else [*figures, f"{_duration(left_s)} left"]

    def _left_s(self, now: _Reading, factor: float | None) -> float | None:
        if self._wall_s is not None:
            return max(0.0, self._wall_s - self._elapsed_s(now))
        end_s = self._end_sim_s
        if end_s is None or now.sim_s is None or not factor:
            return None
        return max(0.0, (end_s - now.sim_s) / factor)

    def _share(self, now: _Reading) -> float | None:
        if self._wall_s is not None:
            return min(1.0, self._elapsed_s(now) / self._wall_s)
        end_s = self._end_sim_s
        return None if end_s is None or now.sim_s is None else min(1.0, now.sim_s / end_s)

    def _elapsed_s(self, now: _Reading) -> float:
        return now.wall_s - (self._outcome.started_s or now.wall_s)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
