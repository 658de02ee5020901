"""Numbers, vectors and truth values in XML."""

from __future__ import annotations

import math
from collections.abc import Sequence

from neuros.convert.elements import Element
from neuros.convert.report import Report


def numbers(
    element: Element, count: int, report: Report, default: Sequence[float]
) -> tuple[float, ...]:
    """``count`` finite numbers; after a problem ``default``."""
    values: list[float] = []
    for word in element.text.split():
        try:
            values.append(float(word))
        except ValueError:
            report.problem(element, f"'{word}' is not a number")
            return tuple(default)
    if len(values) != count:
        what = "a number" if count == 1 else f"{count} numbers"
        report.problem(element, f"{what} must stand here, not {len(values)}")
        return tuple(default)
    if any(math.isnan(value) for value in values):
        report.problem(element, "every number must be one, not nan")
        return tuple(default)
    return tuple(values)


def vector(
    owner: Element, tag: str, report: Report, default: tuple[float, ...]
) -> tuple[float, ...]:
    """The numbers in the child ``tag``, as many as ``default`` has, which holds without it."""
    element = owner.child(tag)
    if element is None or not element.text:
        return default
    values = numbers(element, len(default), report, default)
    if all(map(math.isfinite, values)):
        return values
    report.problem(element, "every number must be finite")
    return default


def number(
    owner: Element, tag: str, report: Report, default: float, *, positive: bool = False
) -> float:
    """The number in the child ``tag``; it may be infinite, unless it must be ``positive``."""
    element = owner.child(tag)
    if element is None or not element.text:
        return default
    (value,) = numbers(element, 1, report, (default,))
    if positive and not 0 < value < math.inf:
        report.problem(element, f"must be a positive number, not {value:g}")
        return default
    return value


def is_true(owner: Element, tag: str, report: Report, *, default: bool) -> bool:
    """The truth value in the child ``tag``."""
    element = owner.child(tag)
    if element is None:
        return default
    word = element.text.lower()
    if word not in ("true", "1", "false", "0"):
        report.problem(element, f"'{element.text}' is neither true nor false")
        return default
    return word in ("true", "1")


def word(owner: Element, tag: str) -> str:
    """The text of the child ``tag``; empty without it."""
    element = owner.child(tag)
    return "" if element is None else element.text
