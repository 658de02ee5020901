"""JSON values with their positions in the file.

Messages to users need the positions of keys and values, and duplicate keys; Python's ``json`` keeps
neither. So this module reads the brackets, and ``json`` the scalars. PyYAML, which keeps positions,
refuses valid JSON: a key of 1025 characters, a character in two escapes, a colon in the line after
its key.
"""

from __future__ import annotations

import json
import math
import os
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

from neuros.errors import Problem
from neuros.ordinary_files import open_ordinary

_MAX_DEPTH = 100
_MOST_BYTES = 4 << 20
_TOKEN = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?|[\w.+-]+|[^ \t\r\n]|\Z', re.DOTALL)
_HALF_CHARACTER = re.compile("[\ud800-\udfff]")


@dataclass(frozen=True)
class Source:
    """A text with JSON in it.

    Attributes:
        name: for messages.
        folder: of relative paths in the text.
        file: that holds the text; ``Path()`` for the value of an option.
        has_lines: whether messages show line and column: the user has not written the JSON of an
            object of Python.
    """

    name: str
    folder: Path
    text: str
    file: Path = Path()
    has_lines: bool = True

    @cached_property
    def _line_starts(self) -> list[int]:
        return [0, *(match.end() for match in re.finditer("\n", self.text))]

    def place(self, position: int) -> tuple[int, int]:
        """Line and column of a position, both from 1; (0, 0) if the source has no lines."""
        if not self.has_lines:
            return 0, 0
        line = bisect_right(self._line_starts, position)
        return line, position - self._line_starts[line - 1] + 1

    def problem(self, position: int, pointer: str, text: str, hint: str = "") -> Problem:
        line, column = self.place(position)
        return Problem(self.name, line, column, pointer or "/" * self.has_lines, text, hint)


@dataclass
class Element:
    """A JSON value and its place.

    Attributes:
        value: a ``dict`` or ``list`` of elements, or the Python value of a scalar.
        start: position of the first character.
        end: position behind the last character.
        key_start: position of the key before the value, ``start`` if there is none.
        pointer: JSON pointer in the file.
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
        """The member of that key, ``None`` if it is missing, or this is no object."""
        return self.value.get(key) if isinstance(self.value, dict) else None

    def string(self, key: str) -> str | None:
        member = self.member(key)
        return member.value if member is not None and isinstance(member.value, str) else None

    def items(self, key: str) -> list[Element]:
        """The items of the array under that key, nothing if there is none."""
        member = self.member(key)
        return member.value if member is not None and isinstance(member.value, list) else []

    def members(self, key: str) -> dict[str, Element]:
        """The members of the object under that key, nothing if there is none."""
        member = self.member(key)
        return member.value if member is not None and isinstance(member.value, dict) else {}

    def at(self, path: Iterable[str | int]) -> Element:
        """The element at the end of a path of keys and indices."""
        element = self
        for step in path:
            value = element.value
            element = value[int(step)] if isinstance(value, list) else value[step]
        return element

    @property
    def where(self) -> str:
        """The place of the value, for messages about another one."""
        line, column = self.source.place(self.start)
        return f"{self.source.name}:{f'{line}:{column}' if line else f' {self.pointer}'}"

    def problem(self, text: str, hint: str = "") -> Problem:
        return self.source.problem(self.start, self.pointer, text, hint)

    def key_problem(self, text: str, hint: str = "") -> Problem:
        return self.source.problem(self.key_start, self.pointer, text, hint)


def escape(key: str) -> str:
    """A key as a part of a JSON pointer (RFC 6901)."""
    return key.replace("~", "~0").replace("/", "~1")


class SourceError(Exception):
    """A file that cannot be read, or is no JSON."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        super().__init__(str(problem))


def display_name(path: Path) -> str:
    """A path as messages show it: relative to the current folder where it lies in there."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def read_bytes(path: Path, most_bytes: int | None = None) -> bytes:
    """The content of a file of the user.

    Raises:
        OSError: if the file cannot be read, has more than ``most_bytes``, or is a pipe or device,
            which may have no end.
    """
    with open_ordinary(path) as file:
        if most_bytes is not None and os.fstat(file.fileno()).st_size > most_bytes:
            raise OSError(f"it has more than {most_bytes >> 20} MiB")
        return file.read()


def half_character(text: str) -> str:
    r"""The problem of a text with a lone ``'\ud800'``, which UTF-8 cannot encode; else empty."""
    found = _HALF_CHARACTER.search(text)
    return f"found half of a character, \\u{ord(found[0]):04x}" if found else ""


def read_file(path: Path) -> tuple[Element, list[Problem]]:
    """Read a JSON file; the problems are its duplicate keys. Raises :class:`SourceError`."""
    name = display_name(path)
    try:
        text = read_bytes(path, _MOST_BYTES).decode("utf-8")
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise SourceError(Problem(name, 1, 1, "/", f"cannot be read: {reason}")) from error
    except UnicodeDecodeError as error:
        before = error.object[: error.start].decode("utf-8")
        problem = Source(name, path.parent, before).problem(
            len(before), "", "is not valid UTF-8", "save the file as UTF-8"
        )
        raise SourceError(problem) from error
    return parse(Source(name, path.parent, text, path))


def parse(source: Source, start: int = 0, pointer: str = "") -> tuple[Element, list[Problem]]:
    """Parse the JSON document from ``start`` to the end. Raises :class:`SourceError`."""
    scanner = _Scanner(source, _TOKEN.finditer(source.text, start))
    if source.text.startswith("\ufeff"):
        scanner.fail(0, pointer, "the file begins with a byte order mark", "save it without")
    element = scanner.value(pointer)
    if scanner.token[0]:
        text = "there is more text after the end of the document"
        scanner.fail(scanner.token.start(), pointer, text)
    return element, scanner.duplicates


class _Scanner:
    """Reads the tokens of a document; the last of them is empty."""

    def __init__(self, source: Source, tokens: Iterator[re.Match[str]]) -> None:
        self._source, self._tokens = source, tokens
        self.token, self.duplicates = next(tokens), list[Problem]()

    def value(self, pointer: str, depth: int = 1) -> Element:
        """Read the value that begins with the current token, up to the token behind it."""
        start, opening = self.token.start(), self.token[0]
        if opening not in ("{", "["):
            value, end = self._scalar(pointer)
            return Element(value, self._source, start, end, pointer)
        if depth > _MAX_DEPTH:
            self.fail(start, pointer, "is nested too deeply")
        found = Element({} if opening == "{" else [], self._source, start, start, pointer)
        closing, what = ("}", "a member") if opening == "{" else ("]", "an item")
        self._advance()
        while self.token[0] != closing:
            self._member(found, depth)
            position = self.token.start()
            if self.token[0] == ",":
                self._advance()
                if self.token[0] == closing:
                    self.fail(position, pointer, f"a comma before '{closing}'", "remove the comma")
            elif self.token[0] != closing:
                self.fail(position, pointer, f"expected ',' or '{closing}' after {what}")
        found.end = self._advance()
        return found

    def _member(self, parent: Element, depth: int) -> None:
        """Add a member or an item to an object or an array."""
        if isinstance(parent.value, list):
            pointer = f"{parent.pointer}/{len(parent.value)}"
            parent.value.append(self.value(pointer, depth + 1))
            return
        start = self.token.start()
        if not self.token[0].startswith('"'):
            self.fail(start, parent.pointer, "expected a key in double quotes")
        key, _ = self._scalar(parent.pointer)
        pointer = f"{parent.pointer}/{escape(key)}"
        if self.token[0] != ":":
            self.fail(self.token.start(), pointer, "expected ':' after the key")
        self._advance()
        member = self.value(pointer, depth + 1)
        member.key_start = start
        if first := parent.value.get(key):
            line, _ = self._source.place(first.key_start)
            text, hint = f"the key '{key}' occurs twice", f"first in line {line}"
            self.duplicates.append(member.key_problem(text, hint))
        parent.value[key] = member

    def _scalar(self, pointer: str) -> tuple[Any, int]:
        start, text = self.token.start(), self.token[0]
        try:
            value = _DECODER.decode(text)
        except json.JSONDecodeError as error:
            if not text.startswith('"'):
                self.fail(start, pointer, "expected a value")
            message = error.msg.removesuffix(" at").replace(" starting", "")
            hint = "is the closing quote missing?" if "\\" not in message else ""
            message = f"bad string: {message[0].lower()}{message[1:]}"
            self.fail(start + error.pos, pointer, message, hint)
        except ValueError as error:  # NaN and the like, or an integer of thousands of digits
            self.fail(start, pointer, str(error))
        if isinstance(value, str) and (half := half_character(value)):
            self.fail(start, pointer, half, "a character beyond \\uffff takes two escapes")
        if isinstance(value, float) and math.isinf(value):
            self.fail(start, pointer, "the number is too large")
        return value, self._advance()

    def _advance(self) -> int:
        """Go to the next token; returns the end of the current one."""
        end = self.token.end()
        self.token = next(self._tokens)
        return end

    def fail(self, position: int, pointer: str, text: str, hint: str = "") -> NoReturn:
        rest = self._source.text[position : position + 2]
        if not rest:
            hint = hint or "the file ends here"
        elif rest[0] == "#" or rest in ("//", "/*"):
            hint = "JSON has no comments"
        elif rest[0] == "'":
            hint = "JSON has double quotes only"
        what = f"syntax error: {text}" if self._source.has_lines else text
        raise SourceError(self._source.problem(position, pointer, what, hint))


def place_of(file: Path, pointer: str) -> tuple[int, int]:
    """Line and column of a pointer in a file; (1, 1) if the file has changed since.

    (0, 0) if there is no such file: the project is one of Python objects.
    """
    if not file.exists():
        return 0, 0
    try:
        root, _ = read_file(file)
        parts = (part.replace("~1", "/").replace("~0", "~") for part in pointer.split("/")[1:])
        element = root.at(parts)
    except (SourceError, LookupError, ValueError, TypeError):
        return 1, 1
    return element.source.place(element.start)


def problem_in(file: Path, pointer: str, text: str, hint: str = "") -> Problem:
    return Problem(display_name(file), *place_of(file, pointer), pointer, text, hint)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


_DECODER = json.JSONDecoder(parse_constant=_refuse_constant)
