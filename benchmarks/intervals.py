"""The median of repeated measurements, how sure it is, and whether it keeps to a bound."""

from __future__ import annotations

import enum
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A range of values, both ends included."""

    low: float
    high: float

    def overlaps(self, other: Interval) -> bool:
        """Whether they have a value in common."""
        return self.low <= other.high and other.low <= self.high


@dataclass(frozen=True)
class Summary:
    """A sample: its median, and the interval of the median (``None``: too few values)."""

    count: int
    median: float
    interval: Interval | None

    @classmethod
    def of(cls, values: Sequence[float]) -> Summary:
        """Summarise at least one value."""
        return cls(len(values), statistics.median(values), median_interval(values))


def median_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval | None:
    """The interval that holds the median of the distribution with at least this confidence.

    It runs from the k-th smallest to the k-th largest value, whatever the distribution is: the
    median lies below the k-th smallest of n values exactly if fewer than k of them are below it,
    and that number is binomial with probability 1/2. (David and Nagaraja, Order Statistics, 3rd
    edition 2003, section 7.1.)

    Returns:
        ``None`` where even smallest to largest says too little: with 5 values or fewer, for 95 %.
    """
    ordered, count = sorted(values), len(values)
    outside = 0.0  # probability that fewer than k values are below the median
    for k in range(1, count // 2 + 2):
        outside += math.comb(count, k - 1) / 2**count
        if outside > (1 - confidence) / 2:
            break
    k -= 1
    return Interval(ordered[k - 1], ordered[-k]) if k else None


class Verdict(enum.Enum):
    """Whether a median keeps to a bound."""

    YES = "yes"
    """The whole interval does."""
    WITHIN = "within"
    """The interval contains the bound: it is reached, and no more can be said."""
    NO = "NO"
    """No value of the interval does."""
    UNKNOWN = "?"
    """There are too few values for an interval."""

    @property
    def is_met(self) -> bool:
        """Whether the target is reached."""
        return self in (Verdict.YES, Verdict.WITHIN)


def judge(summary: Summary, limit: float, is_maximum: bool) -> Verdict:
    """Hold the interval of a median against a limit."""
    if summary.interval is None:
        return Verdict.UNKNOWN
    sign = 1 if is_maximum else -1
    best, worst = sorted((sign * summary.interval.low, sign * summary.interval.high))
    if worst <= sign * limit:
        return Verdict.YES
    return Verdict.WITHIN if best <= sign * limit else Verdict.NO
