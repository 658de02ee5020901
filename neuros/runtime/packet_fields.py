"""The fields of a packet by their paths: ``pose.position.x``, ``ranges[3]``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

Path: TypeAlias = "tuple[str | int, ...]"

MOST_FIELDS = 300
MOST_ELEMENTS = 12
_LONGEST_TEXT = 200
_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(\d+)\]")


def parse_path(text: str) -> Path:
    """The steps of a path, names of fields and places in sequences."""
    return tuple(
        name if name else int(place) for name, place in (m.groups() for m in _STEP.finditer(text))
    )


def number_at(packet: Any, path: Path) -> float | None:
    """The number there; ``None`` if there is nothing, or no (finite) number."""
    try:
        for step in path:
            packet = packet[step] if isinstance(step, int) else getattr(packet, step)
        number = float(packet)
    except (AttributeError, LookupError, TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def all_fields(packet: Any, most_elements: int = 0) -> dict[str, Any]:
    """Every field, by its path: numbers, texts, and how long sequences are (``data.length``).

    Args:
        most_elements: of a sequence of numbers, so many are listed; 0: :data:`MOST_ELEMENTS`.
    """
    found: dict[str, Any] = {}
    for path, value in _walk(packet, "", most_elements or MOST_ELEMENTS):
        found[path] = value
        if len(found) >= max(MOST_FIELDS, most_elements):
            break
    return found


def _walk(value: Any, path: str, most: int) -> Iterator[tuple[str, Any]]:
    if hasattr(value, "get_fields_and_field_types"):
        for name in value.get_fields_and_field_types():
            yield from _walk(getattr(value, name), f"{path}.{name}" if path else name, most)
    elif isinstance(value, str):
        yield path, value[:_LONGEST_TEXT]
    elif isinstance(value, bool | int):
        yield path, value
    elif hasattr(value, "__len__"):
        yield f"{path}.length", len(value)
        yield from _elements(value, path, most)
    else:
        try:
            number = float(value)
        except (TypeError, ValueError):
            return
        yield path, number if math.isfinite(number) else str(number)


def _elements(values: Sequence[Any], path: str, most: int) -> Iterator[tuple[str, Any]]:
    for place, each in enumerate(values[:most]):
        yield from _walk(each, f"{path}[{place}]", most)
