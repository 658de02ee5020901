"""Rows: what was measured in each round, compared with what, and held against which bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.intervals import Summary, Verdict, judge
from benchmarks.measure import Case, Round
from benchmarks.targets import BOUNDS, Bound


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        values: one per round, in ``unit``.
        references: of the same rounds; empty where it is compared with nothing.
        bound: a key of :data:`benchmarks.targets.BOUNDS`.
    """

    subject: str
    name: str
    unit: str
    values: tuple[float, ...]
    against: str = ""
    references: tuple[float, ...] = ()
    bound: str | None = None

    @property
    def key(self) -> tuple[str, str]:
        """What tells it from other rows."""
        return self.subject, self.name

    @property
    def ratios(self) -> tuple[float, ...]:
        """Value over reference of each round; empty without a reference."""
        if not self.references:
            return ()
        pairs = zip(self.values, self.references, strict=True)
        return tuple(value / other if other else math.inf for value, other in pairs)

    @property
    def summary(self) -> Summary:
        """Of the values."""
        return Summary.of(self.values)

    @property
    def judged(self) -> Summary:
        """Of what a bound is for: the ratios, or the values where there is no reference."""
        return Summary.of(self.ratios or self.values)

    @property
    def bound_or_none(self) -> Bound | None:
        """Its bound; results of another version may name one that is no more."""
        return BOUNDS.get(self.bound) if self.bound else None

    def verdict(self, limit: float | None) -> Verdict | None:
        """Whether it keeps to the limit, or the goal, of its bound; ``None`` without one."""
        bound = self.bound_or_none
        if bound is None or limit is None:
            return None
        return judge(self.judged, limit, bound.is_maximum)

    def as_json(self) -> dict[str, Any]:
        """Plain data, with every single value."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Row:
        """The inverse of :meth:`as_json`."""
        lists = {name: tuple(data[name]) for name in ("values", "references")}
        return cls(**{**data, **lists})


def row_of(subject: str, case: Case, rounds: Sequence[Round]) -> Row | None:
    """The row of a case from the rounds that measured all it needs; ``None`` if none did."""
    complete = [each for each in rounds if case.candidates <= each.keys()]
    if not complete:
        return None
    reference = case.reference
    return Row(
        subject,
        case.name,
        case.unit,
        tuple(case.value.of(each) for each in complete),
        case.against,
        tuple(reference.of(each) for each in complete) if reference else (),
        case.bound,
    )
