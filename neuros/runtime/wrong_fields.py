"""Which field of a packet holds what cannot be sent.

Messages of ROS take any value and fail when they are serialised, with a text that names no field.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from typing import Any


def wrong_field(packet: Any) -> str:
    """The first field whose value is not of its type, in words; empty if all are."""
    return next(_wrong(packet, ""), "")


def _wrong(message: Any, prefix: str) -> Iterator[str]:
    if not hasattr(message, "get_fields_and_field_types"):
        return
    strict = type(message)(check_fields=True)
    for name, kind in message.get_fields_and_field_types().items():
        value, path = getattr(message, name), f"{prefix}{name}"
        try:
            setattr(strict, name, value)
        except (AssertionError, TypeError, ValueError, OverflowError):
            found = f"{reprlib.repr(value)} ({type(value).__name__})"
            yield f"field '{path}' must be {kind}, but is {found}"
            continue
        yield from _wrong(value, f"{path}.")
        if "/" in kind and isinstance(value, list | tuple):
            for place, item in enumerate(value):
                yield from _wrong(item, f"{path}[{place}].")
