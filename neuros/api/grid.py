"""The points of a sweep: every combination of values, seeds and repetitions."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuros.api.project import value_text
from neuros.errors import UsageError

_MOST_CHARACTERS = 80
# Columns of the table that are none of a value.
_TAKEN = {
    *("seed", "repeat", "exit_code", "reason"),
    *("wall_s", "sim_s", "real_time_factor", "folder"),
}
_OPENING, _CLOSING = "[{", "]}"


@dataclass(frozen=True)
class Point:
    """One run of a sweep.

    Attributes:
        settings: values by path.
        seed: for all nodes that have one, ``None``: as in the files.
        repeat: which repetition it is, from 1; ``None`` where there is one only.
    """

    settings: Mapping[str, Any]
    seed: int | None = None
    repeat: int | None = None

    def values(self, names: Mapping[str, str]) -> dict[str, Any]:
        """What tells it from others; ``names``: of the columns, by path."""
        found = {names[path]: value for path, value in self.settings.items()}
        found |= {} if self.seed is None else {"seed": self.seed}
        return found | ({} if self.repeat is None else {"repeat": self.repeat})

    def folder_name(self, names: Mapping[str, str]) -> str:
        """A name for its folder: readable, and never that of another point."""
        settings = sorted((path, value_text(path, v)) for path, v in self.settings.items())
        identity = (settings, self.seed, self.repeat)
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:8]
        text = "_".join(f"{name}={value}" for name, value in self.values(names).items()) or "run"
        return f"{re.sub(r'[^A-Za-z0-9._=+-]', '-', text)[:_MOST_CHARACTERS]}-{digest}"


def points_of(
    values: Mapping[str, Sequence[Any]], seeds: Sequence[int], repeat: int
) -> list[Point]:
    """The grid; what is named last changes first.

    Raises:
        UsageError: if there is no value for something, or one twice.
    """
    if repeat < 1:
        raise UsageError(f"repeat {repeat}: give 1 or more")
    for name, given in {**values, "seeds": seeds}.items():
        texts = [value_text(name, value) for value in given]
        twice = {text for text in texts if texts.count(text) > 1}
        if twice:
            raise UsageError(f"{name}: {', '.join(sorted(twice))} is given twice")
        if not texts and name != "seeds":
            raise UsageError(f"{name}: give a value")
    repeats: Sequence[int | None] = [None] if repeat == 1 else range(1, repeat + 1)
    return [
        Point(dict(zip(values, combination, strict=True)), seed, number)
        for combination in itertools.product(*values.values())
        for seed in (seeds or (None,))
        for number in repeats
    ]


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """What to call paths: their last steps, as few as tell them apart."""
    names = {}
    for path in paths:
        steps = path.split(".")
        count = 2 if steps[-1] in _TAKEN else 1
        while any(other != path and other.split(".")[-count:] == steps[-count:] for other in paths):
            count += 1
        names[path] = ".".join(steps[-count:])
    return names


def parse_values(text: str) -> tuple[str, list[Any]]:
    """``PATH=1,2,3`` as on the command line: commas within brackets and quotes are no separators.

    Raises:
        UsageError: if it is not of this form.
    """
    path, equals, listed = text.partition("=")
    if not (path and equals):
        raise UsageError(f"--set {text}: is not of the form PATH=VALUE,VALUE,...")
    is_text = path.split(".")[2:3] == ["environment"]
    return path, [part if is_text else _json_or_text(part) for part in _split(listed)]


def _split(text: str) -> Iterator[str]:
    depth, in_quotes, start = 0, False, 0
    for place, character in enumerate(text):
        if character == '"':
            in_quotes = not in_quotes
        elif not in_quotes:
            depth += (character in _OPENING) - (character in _CLOSING)
            if character == "," and depth == 0:
                yield text[start:place]
                start = place + 1
    yield text[start:]


def _json_or_text(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
