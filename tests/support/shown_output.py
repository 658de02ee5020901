"""What the pages of the examples say is printed, and whether a run has printed it.

Of the moment, and not compared: the launcher's other lines, times of day, durations (``in 7.7 s``),
which Python a machine has, where the rover is when its battery is started, and how many estimates a
slow plot of WhiskEye has seen. What is measured (a number with a decimal point) may be off by a
quarter. All else is compared: the lines of a node, in their order, their words and whole numbers;
and the counters of connections that have lost nothing, but for a packet on its way at the end.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from launching import EXAMPLES, Finished

Line = tuple[str, str]
"""Who says it, and what."""

_ENTRY = re.compile(r"^## \[[^]\n]+\]\((\S+)\)\n(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
_BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.MULTILINE | re.DOTALL)
_LINE = re.compile(r"^(?:\[[A-Z]+\] \[[\d.]+\] )?\[(\w+)\]: (.*)$", re.MULTILINE)
_ROW = re.compile(r"^(\S+ -> \S+)((?:  +\d+){5})$", re.MULTILINE)
_OF_THE_MOMENT = re.compile(
    r"\d\d:\d\d:\d\d|\bin [\d.]+ s\b|\bPython [\d.]+|\bat [\d.]+ m\b|\bover \d+ estimates"
)
_NUMBER = re.compile(r"\d+(?:\.\d+)*")
_COUNTED = ("sent", "received", "consumed", "discarded", "lost")
OFF_BY = 0.25
ON_ITS_WAY = 1


@dataclass(frozen=True)
class Entry:
    """An example: the command that its entry shows, and what entry and page show of its output."""

    page: Path
    command: tuple[str, ...]
    lines: list[Line]
    lines_of_page: list[Line]
    counters: dict[str, list[int]]

    @property
    def name(self) -> str:
        return self.page.parent.name


def entries() -> list[Entry]:
    """The gallery, in its order."""
    text = (EXAMPLES / "README.md").read_text("utf-8")
    return [_entry(EXAMPLES / page, body) for page, body in _ENTRY.findall(text)]


def _entry(page: Path, body: str) -> Entry:
    (block,) = _BLOCK.findall(body)
    first, _, shown = block.partition("\n")
    prompt, program, *command = first.split()
    assert (prompt, program) == ("$", "./launch.py")
    printed = page.read_text("utf-8").partition("## What it prints")[2]
    of_page = next(each for each in _BLOCK.findall(printed) if lines_of(each))
    rows = {name: [int(cell) for cell in cells.split()] for name, cells in _ROW.findall(of_page)}
    return Entry(page, tuple(command), lines_of(shown), lines_of(of_page), rows)


def lines_of(text: str) -> list[Line]:
    """What nodes say there, and the launcher of why the run ended."""
    found = [(name, said) for name, said in _LINE.findall(text)]
    return [each for each in found if each[0] != "neuros" or "ended the project" in each[1]]


def missing(shown: list[Line], run: Finished) -> list[Line]:
    """The lines shown that the run has not printed, each node's in their order."""
    left = {name: iter(run.said(name)) for name, _ in shown}
    return [(name, text) for name, text in shown if not any(is_same(text, t) for t in left[name])]


def is_same(shown: str, printed: str) -> bool:
    """Whether a line is the one shown; ``...`` stands for anything."""
    shown, printed = (_OF_THE_MOMENT.sub("", text) for text in (shown, printed))
    words = [re.escape(part) for part in _NUMBER.split(shown)]
    pattern = r"(\d+(?:\.\d+)*)".join(words).replace(r"\.\.\.", ".*")
    match = re.fullmatch(pattern, printed)
    return match is not None and all(map(_is_near, _NUMBER.findall(shown), match.groups()))


def _is_near(shown: str, printed: str) -> bool:
    is_measured = shown.count(".") == printed.count(".") == 1
    return shown == printed or (
        is_measured and float(printed) == pytest.approx(float(shown), rel=OFF_BY)
    )


def miscounted(entry: Entry, run: Finished) -> dict[str, list[int]]:
    """The counters of the run that are not those shown, where nothing was lost."""
    counted = {name: [run.connection(name)[key] for key in _COUNTED] for name in entry.counters}
    return {
        name: counted[name]
        for name, shown in entry.counters.items()
        if shown[-2:] == [0, 0]
        and any(abs(a - b) > ON_ITS_WAY for a, b in zip(shown, counted[name], strict=True))
    }
