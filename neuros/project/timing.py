"""Durations of hooks and delays of connections in virtual time: numbers, distributions, draws.

A draw depends on the seed of the run, a name and a number alone, so its order, the back end, a
reset and a fork change nothing. It is the same on every machine: it uses BLAKE2b, the four basic
operations of floats, ``sqrt``, which IEEE 754 rounds exactly, and the logarithm and exponential
function of :mod:`decimal`, which are rounded exactly, too; libm is not involved.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Context
from functools import reduce
from hashlib import blake2b
from typing import Any, Protocol

REAL, VIRTUAL = "real", "virtual"
"""The clocks of a run: that of the machine, or one that only declared times move on."""
LEAST_DELAY_NS = 1_000
"""Events of two nodes at one instant are independent, since every packet needs this long."""
MOST_NS = 86_400_000_000_000
"""A day; longer draws are cut."""

_ARITHMETIC = Context(prec=20)
_NAMES = {"normal": 2, "lognormal": 2, "uniform": 2, "samples": None}

# Wichura (1988), Algorithm AS 241, Applied Statistics 37(3), PPND7: relative error below 1e-7.
_CENTRE = (
    (3.3871327179e0, 5.0434271938e1, 1.5929113202e2, 5.9109374720e1),
    (1.0, 1.7895169469e1, 7.8757757664e1, 6.7187563600e1),
)
_SHOULDER = (
    (1.4234372777e0, 2.7568153900e0, 1.3067284816e0, 1.7023821103e-1),
    (1.0, 7.3700164250e-1, 1.2021132975e-1),
)
_TAIL = (
    (6.6579051150e0, 3.0812263860e0, 4.2868294337e-1, 1.7337203997e-2),
    (1.0, 2.4197894225e-1, 1.2258202635e-2),
)


class WithEnvironment(Protocol):
    """A node, as far as seeds are concerned."""

    @property
    def name(self) -> str: ...
    @property
    def environment(self) -> Mapping[str, str]: ...


@dataclass(frozen=True)
class Distribution:
    """A duration or delay in seconds: a constant, or a distribution to draw from.

    Attributes:
        kind: ``constant``, ``normal``, ``lognormal``, ``uniform`` or ``samples``.
        values: the constant; mean and standard deviation; the median, and the standard deviation
            of the logarithm; least and largest value; or the samples.
    """

    kind: str
    values: tuple[float, ...]

    @classmethod
    def of(cls, written: Any) -> Distribution:
        """The distribution that valid JSON describes; anything else raises ``ValueError``."""
        if isinstance(written, int | float) and not isinstance(written, bool):
            return cls("constant", (float(written),))
        if not isinstance(written, Mapping) or len(written) != 1:
            raise ValueError(written)
        ((kind, values),) = written.items()
        count = _NAMES.get(kind, 0)
        found = tuple(map(float, values))
        if not found or (count is not None and len(found) != count):
            raise ValueError(written)
        return cls(kind, found)

    @property
    def keys(self) -> Any:
        return self.values[0] if self.kind == "constant" else {self.kind: list(self.values)}

    @property
    def least_ns(self) -> int:
        """No draw is shorter (nanoseconds)."""
        return 0 if self.kind in ("normal", "lognormal") else _nanoseconds(min(self.values))

    def at_ns(self, share: float) -> int:
        """The duration of which this share is not longer (nanoseconds, from 0 to a day).

        Args:
            share: more than 0, less than 1; of samples, it chooses one in the order of the list.
        """
        values = self.values
        if self.kind == "constant":
            return _nanoseconds(values[0])
        if self.kind == "samples":
            return _nanoseconds(values[int(share * len(values))])
        if self.kind == "uniform":
            low, high = values
            return _nanoseconds(low + (high - low) * share)
        deviates = standard_normal(share) * values[1]
        if self.kind == "normal":
            return _nanoseconds(values[0] + deviates)
        factor = _ARITHMETIC.exp(_ARITHMETIC.create_decimal_from_float(deviates))
        return _nanoseconds(values[0] * float(factor))


class Draws:
    """The draws of one quantity of a run, by number: a hook's durations, a connection's delays.

    Args:
        seed: of the run; see :func:`seed_of`.
        names: of the quantity, such as ``"delay"`` and the name of the connection.
    """

    __slots__ = ("_hash",)

    def __init__(self, seed: str, *names: str) -> None:
        self._hash = blake2b(json.dumps([seed, *names]).encode(), digest_size=8)

    def share(self, number: int) -> float:
        """A number between 0 and 1, both excluded, evenly distributed."""
        drawn = self._hash.copy()
        drawn.update(number.to_bytes(8, "little"))
        return ((int.from_bytes(drawn.digest(), "little") >> 12) + 0.5) / (1 << 52)


def standard_normal(share: float) -> float:
    """The quantile of the standard normal distribution, with a relative error below 1e-7."""
    q = share - 0.5
    if abs(q) <= 0.425:
        return q * _ratio(_CENTRE, 0.180625 - q * q)
    tail = share if q < 0 else 1.0 - share
    r = math.sqrt(-float(_ARITHMETIC.ln(_ARITHMETIC.create_decimal_from_float(tail))))
    value = _ratio(_SHOULDER, r - 1.6) if r <= 5.0 else _ratio(_TAIL, r - 5.0)
    return -value if q < 0 else value


def seeds(nodes: Iterable[WithEnvironment]) -> dict[str, dict[str, str]]:
    """By node, the variables of its environment with SEED in their names."""
    found = {
        node.name: {key: value for key, value in node.environment.items() if "SEED" in key.upper()}
        for node in nodes
    }
    return {name: variables for name, variables in found.items() if variables}


def seed_of(nodes: Iterable[WithEnvironment]) -> str:
    """The seed of all draws of a run: the variables with SEED in their names, of all nodes."""
    return json.dumps(seeds(nodes), sort_keys=True)


def _ratio(polynomials: tuple[tuple[float, ...], tuple[float, ...]], x: float) -> float:
    above, below = (reduce(lambda sum_, a: sum_ * x + a, each[::-1]) for each in polynomials)
    return above / below


def _nanoseconds(seconds: float) -> int:
    """Whole nanoseconds from 0 to a day."""
    return min(max(0, round(min(seconds, 1e6) * 1e9)), MOST_NS)
