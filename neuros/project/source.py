"""JSON values with their positions in the file; :mod:`neuros.project.scanner` makes them."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from neuros.errors import Problem


@dataclass(frozen=True)
class Source:
    """A text with JSON in it.

    Attributes:
        name: what messages call it.
        folder: where relative paths in it start.
        file: the file that it was read from, if it was.
    """

    name: str
    folder: Path
    text: str
    file: Path = Path()

    @cached_property
    def _line_starts(self) -> list[int]:
        return [0, *(match.end() for match in re.finditer("\n", self.text))]

    def place(self, position: int) -> tuple[int, int]:
        """Line and column of a position, both from 1."""
        line = bisect_right(self._line_starts, position)
        return line, position - self._line_starts[line - 1] + 1

    def problem(self, position: int, pointer: str, text: str, hint: str = "") -> Problem:
        """A problem at a position; the whole document is shown as ``/``."""
        line, column = self.place(position)
        return Problem(self.name, line, column, pointer or "/", text, hint)


@dataclass
class Element:
    """A JSON value and its place.

    Attributes:
        value: a ``dict`` or ``list`` of elements, or what ``json.loads`` makes of a scalar.
        start: position of the first character; ``end`` is behind the last one.
        key_start: position of the key in front of it, ``start`` where there is none.
        pointer: its JSON pointer in the file.
    """

    value: Any
    source: Source
    start: int
    end: int
    pointer: str = ""
    key_start: int = -1

    def __post_init__(self) -> None:
        if self.key_start < 0:
            self.key_start = self.start

    @property
    def text(self) -> str:
        """The value as it is written."""
        return self.source.text[self.start : self.end]

    @property
    def plain(self) -> Any:
        """The value as ``json.loads`` would return it."""
        if isinstance(self.value, dict):
            return {key: member.plain for key, member in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain for item in self.value]
        return self.value

    def member(self, key: str) -> Element | None:
        """The member of that key, ``None`` if this is no object or has none."""
        return self.value.get(key) if isinstance(self.value, dict) else None

    def string(self, key: str) -> str | None:
        """The member of that key if it is a string."""
        member = self.member(key)
        return member.value if member is not None and isinstance(member.value, str) else None

    def items(self, key: str) -> list[Element]:
        """The items of the array under that key, nothing if there is none."""
        member = self.member(key)
        return member.value if member is not None and isinstance(member.value, list) else []

    def at(self, path: Iterable[str | int]) -> Element:
        """The element at the end of a path of keys and indices."""
        element = self
        for step in path:
            element = element.value[step]
        return element

    def problem(self, text: str, hint: str = "") -> Problem:
        """A problem with the value."""
        return self.source.problem(self.start, self.pointer, text, hint)

    def key_problem(self, text: str, hint: str = "") -> Problem:
        """A problem with the key."""
        return self.source.problem(self.key_start, self.pointer, text, hint)


def escape(key: str) -> str:
    """A key as a part of a JSON pointer (RFC 6901)."""
    return key.replace("~", "~0").replace("/", "~1")
