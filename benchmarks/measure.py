"""What a subject declares, and how it is measured: side by side, in rounds.

Machines differ, and one machine differs from minute to minute. So nothing is measured alone: each
*round* measures all candidates of a group one after the other, every other round in the opposite
order, and two candidates are compared within the rounds. A round may be cut into *slices*, shorter
measurements there and back (A B B A): what changes steadily meanwhile hits both alike.
"""

from __future__ import annotations

import statistics
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Union

Round = dict[str, dict[str, float]]
"""What one round measured: candidate, figure, value."""

Measurement = Callable[[], Union[float, Mapping[str, float]]]  # noqa: UP007 (evaluated on 3.10)
"""Measures once: one figure, which is then called ``value``, or several by name."""

MINIMUM_PAIRS = 10
_ENOUGH_FAILURES = 2


class Unavailable(Exception):
    """What a measurement needs is not there (a second core, a package); the text says what."""


@dataclass(frozen=True)
class Figure:
    """A figure that a candidate's measurement returns."""

    candidate: str
    name: str = "value"

    @property
    def candidates(self) -> frozenset[str]:
        """Whose measurements it needs."""
        return frozenset({self.candidate})

    def of(self, measured: Round) -> float:
        """Its value in a round; raises ``KeyError`` where the measurement has no such figure."""
        return measured[self.candidate][self.name]


@dataclass(frozen=True)
class Quotient:
    """One value divided by another one of the same round."""

    dividend: Value
    divisor: Value

    @property
    def candidates(self) -> frozenset[str]:
        """Whose measurements it needs."""
        return self.dividend.candidates | self.divisor.candidates

    def of(self, measured: Round) -> float:
        """Its value in a round."""
        return self.dividend.of(measured) / self.divisor.of(measured)


@dataclass(frozen=True)
class Difference:
    """One value without another one of the same round."""

    minuend: Value
    subtrahend: Value

    @property
    def candidates(self) -> frozenset[str]:
        """Whose measurements it needs."""
        return self.minuend.candidates | self.subtrahend.candidates

    def of(self, measured: Round) -> float:
        """Its value in a round."""
        return self.minuend.of(measured) - self.subtrahend.of(measured)


Value = Union[Figure, Quotient, Difference]  # noqa: UP007 (evaluated on 3.10)


@dataclass(frozen=True)
class Case:
    """A row of the table before it is measured.

    Attributes:
        unit: of the value: us, 1/s, MB (1e6 bytes), empty for shares and factors.
        reference: what the value is compared with, in the same round and unit.
        against: what the reference is called in the table.
        bound: a key of :data:`benchmarks.targets.BOUNDS`; it judges the ratio to the reference,
            or the value where there is none.
    """

    name: str
    unit: str
    value: Value
    reference: Value | None = None
    against: str = ""
    bound: str | None = None

    @property
    def candidates(self) -> frozenset[str]:
        """Whose measurements it needs."""
        return self.value.candidates | (self.reference.candidates if self.reference else set())


@dataclass(frozen=True)
class Group:
    """Candidates that are measured in the same rounds, and the rows that follow from them.

    Attributes:
        slices: how often each is measured in a round; the round has the means.
    """

    candidates: Mapping[str, Measurement]
    cases: tuple[Case, ...]
    rounds: int = MINIMUM_PAIRS
    slices: int = 1

    def only(self, text: str) -> Group:
        """The part that is needed for the rows whose names contain ``text``."""
        cases = tuple(case for case in self.cases if text.lower() in case.name.lower())
        needed = frozenset[str]().union(*(case.candidates for case in cases))
        candidates = {name: each for name, each in self.candidates.items() if name in needed}
        return replace(self, candidates=candidates, cases=cases)


@dataclass(frozen=True)
class Subject:
    """A topic that can be measured by itself: ``neuros benchmark NAME``."""

    description: str
    groups: tuple[Group, ...]


@dataclass
class Run:
    """A group while it is measured.

    Attributes:
        rounds: what was measured, round by round; a round may lack candidates.
        unavailable: why a candidate is not measured here.
        failures: what went wrong with a candidate, once or more.
    """

    group: Group
    rounds: list[Round] = field(default_factory=list)
    unavailable: dict[str, str] = field(default_factory=dict)
    failures: dict[str, list[str]] = field(default_factory=dict)

    def measure(self, rounds: int, say: Callable[[str], None]) -> Iterator[None]:
        """Measure; yields after each candidate, what was measured by then is in ``rounds``."""
        for number in range(rounds):
            self.rounds.append({})
            slices: dict[str, list[dict[str, float]]] = {}
            for piece in range(self.group.slices):
                # A candidate that failed has lost the whole round.
                names = [n for n in self._names() if len(slices.get(n, ())) == piece]
                for name in reversed(names) if (number + piece) % 2 else names:
                    figures = self._measure_once(name, f"  {number + 1}/{rounds} {name}: ", say)
                    if figures is not None:
                        measured = slices.setdefault(name, [])
                        measured.append(figures)
                        if len(measured) == self.group.slices:
                            self.rounds[-1][name] = _means(measured)
                    yield

    def _names(self) -> list[str]:
        """The candidates that are worth a try, and that some row still has use for."""
        lost = {*self.unavailable}
        lost |= {name for name, each in self.failures.items() if len(each) >= _ENOUGH_FAILURES}
        cases = [case for case in self.group.cases if not case.candidates & lost]
        needed = frozenset[str]().union(*(case.candidates for case in cases))
        return [name for name in self.group.candidates if name in needed]

    def _measure_once(
        self, name: str, label: str, say: Callable[[str], None]
    ) -> dict[str, float] | None:
        if name in self.unavailable:
            return None
        try:
            figures = self.group.candidates[name]()
        except Unavailable as reason:
            self.unavailable[name] = str(reason)
            say(f"{label}left out: {reason}")
        except Exception as error:  # one broken measurement must not cost the others
            self.failures.setdefault(name, []).append(_describe(error))
            say(f"{label}FAILED: {_describe(error).splitlines()[-1]}")
        else:
            named = figures if isinstance(figures, Mapping) else {"value": figures}
            say(label + ", ".join(f"{value:.4g}" for value in named.values()))
            return {key: float(value) for key, value in named.items()}
        return None


def _means(slices: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {key: statistics.fmean(each[key] for each in slices) for key in slices[0]}


def _describe(error: Exception) -> str:
    text = f"{type(error).__name__}: {error}"
    if isinstance(error, subprocess.CalledProcessError | subprocess.TimeoutExpired):
        text += f"\n{error.stderr or error.output or ''}"
    return text.strip()
