"""Simulated time as whole numbers of steps.

Simulated time is never added up in floating point: it is the number of steps times the timestep,
a fraction, so a stamp after an hour is as exact as the first one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from fractions import Fraction

_LARGEST_DENOMINATOR = 1_000_000
_TIMESTEP_TOLERANCE = Fraction(1, 10_000_000)
_PERIOD_TOLERANCE = Fraction(1, 1_000_000)


class Timebase:
    """Converts steps to time for one timestep, in seconds.

    Whole nanoseconds are taken as written (``0.002`` is 1/500); a rounded ``0.0041666667`` is
    taken as the 1/240 that it stands for.

    Attributes:
        timestep_s: the float next to that.
    """

    def __init__(self, timestep_s: float) -> None:
        self._step = _as_fraction(timestep_s)
        self._numerator, self._denominator = self._step.as_integer_ratio()
        self.timestep_s = float(self._step)

    def seconds(self, steps: int) -> float:
        """The time after ``steps``, correctly rounded."""
        return steps * self._numerator / self._denominator

    def nanoseconds(self, steps: int) -> int:
        """The time after ``steps`` in whole nanoseconds, halves rounded up."""
        twice = 2 * steps * self._numerator * 1_000_000_000 + self._denominator
        return twice // (2 * self._denominator)

    def period_steps(self, rate_hz: float) -> int:
        """Steps between two firings at ``rate_hz``; ``ValueError`` if not a whole number."""
        steps = 1 / (Fraction(repr(float(rate_hz))) * self._step)
        whole = max(1, round(steps))
        if abs(steps - whole) <= _PERIOD_TOLERANCE * steps:
            return whole
        below = max(1, int(steps))
        nearest = " and ".join(
            f"{float(1 / (count * self._step)):.10g} Hz (every {count} steps)"
            for count in sorted({below, below + 1})
        )
        raise ValueError(
            f"{rate_hz:g} Hz is a period of {float(steps):.6g} timesteps of {self.timestep_s:g} s, "
            f"which is not a whole number; the nearest rates are {nearest}"
        )


class Schedule:
    """When which sensor fires: every ``periods[name]`` steps, the first time after one period."""

    def __init__(self, periods: Mapping[str, int]) -> None:
        self._periods = dict(periods)

    def next_firing(self, step: int) -> int | None:
        """The first step after ``step`` at which any sensor fires; ``None`` without sensors."""
        return min(
            [step - step % period + period for period in self._periods.values()], default=None
        )

    def due(self, step: int) -> tuple[str, ...]:
        """The sensors that fire at ``step``, in the order of their declaration."""
        return tuple([n for n, period in self._periods.items() if step and step % period == 0])

    def find_crossing(
        self, unread: Collection[str], step: int, target: int
    ) -> tuple[str, int, int] | None:
        """A sensor that a way from ``step`` to ``target`` would cost a packet.

        That is one with an unread packet that fires, or one that fires twice. Returns its name and
        the steps of the two firings, or ``None``.
        """
        for name, period in self._periods.items():
            last = step - step % period
            first = last if name in unread else last + period
            if first + period <= target:
                return name, first, first + period
        return None

    def __contains__(self, name: object) -> bool:
        return name in self._periods

    def __iter__(self) -> Iterator[str]:
        return iter(self._periods)


def _as_fraction(timestep_s: float) -> Fraction:
    exact = Fraction(repr(float(timestep_s)))
    if (exact * 1_000_000_000).denominator == 1:
        return exact
    near = exact.limit_denominator(_LARGEST_DENOMINATOR)
    return near if abs(near - exact) <= exact * _TIMESTEP_TOLERANCE else exact
