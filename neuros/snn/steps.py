"""Simulated time as a whole number of a simulator's steps: integers, so that nothing drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class PartialDelayWarning(UserWarning):
    """A step is a whole number of the resolution, but not of the shortest delay."""


@dataclass(frozen=True)
class StepGrid:
    """What lengths a step may have.

    Args:
        resolution_ns: the simulator's own step, in nanoseconds.
        min_delay_ns: the shortest delay of the network, a whole number of resolutions: so often its
            spikes are exchanged.

    Raises:
        ValueError: the delay is not a whole number of resolutions, or one of them is not above 0.
    """

    resolution_ns: int
    min_delay_ns: int

    def __post_init__(self) -> None:
        if self.resolution_ns <= 0 or self.min_delay_ns <= 0:
            raise ValueError(f"resolution and delay must be above 0 ns: got {self}")
        if self.min_delay_ns % self.resolution_ns:
            raise ValueError(
                f"a delay of {self.min_delay_ns} ns is not a whole number of {self.resolution_ns}"
            )

    def steps(self, duration_ns: int) -> int:
        """So many resolutions make up a duration.

        Raises ``ValueError``, with the nearest lengths that do, where that is no whole number.
        """
        steps, rest_ns = divmod(duration_ns, self.resolution_ns)
        if steps < 1 or rest_ns:
            raise ValueError(self._refusal(duration_ns, self.resolution_ns, "the resolution"))
        return steps

    def partial_delay(self, duration_ns: int) -> str:
        """What is wrong with a step that is no whole number of shortest delays; empty if it is."""
        if duration_ns % self.min_delay_ns == 0:
            return ""
        return self._refusal(duration_ns, self.min_delay_ns, "the shortest delay")

    @staticmethod
    def _refusal(duration_ns: int, unit_ns: int, name: str) -> str:
        below = max(0, duration_ns) // unit_ns * unit_ns
        near = [f"{length / NS_PER_MS:g} ms" for length in (below, below + unit_ns) if length > 0]
        return (
            f"a step of {duration_ns / NS_PER_MS:.9g} ms is not a whole number of "
            f"{unit_ns / NS_PER_MS:g} ms, {name}: {' and '.join(near)} "
            f"{'are' if len(near) > 1 else 'is'}"
        )


def nanoseconds(seconds: float) -> int:
    """The whole nanoseconds nearest to a duration. Exact for every multiple of 1 ns up to 52 days.

    Raises ``ValueError`` where it is not finite.
    """
    if not math.isfinite(seconds):
        raise ValueError(f"a duration must be finite: got {seconds!r} s")
    return round(seconds * NS_PER_S)


def nanoseconds_of_ms(milliseconds: float) -> int:
    """The same for milliseconds, as NEST counts."""
    return round(milliseconds * NS_PER_MS)
