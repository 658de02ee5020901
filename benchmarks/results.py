"""The results file: rows, every single value, and what they were measured on.

It is written anew after each measurement, so that whatever ends a run, what was measured is kept.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from benchmarks.machine import machine, versions
from benchmarks.measure import Round
from benchmarks.rows import Row
from neuros.errors import UsageError

SCHEMA = 2


@dataclass(frozen=True)
class Notice:
    """A row that was not measured, or not in every round, and why."""

    subject: str
    row: str
    reason: str
    is_failure: bool


@dataclass(frozen=True)
class Origin:
    """A run of the benchmarks, among several whose rows were put together, and its subjects."""

    started: str
    commit: str
    subjects: tuple[str, ...]


@dataclass
class Results:
    """All that one run of the benchmarks found out.

    Attributes:
        load_before: by subject, the share of all cores that others kept busy just before.
        rounds: by subject, what each round of each group measured: candidate, figure, value.
        origins: where the rows are from, if from several runs.
    """

    started: str = ""
    is_quick: bool = False
    machine: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    load_before: dict[str, float] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)
    rounds: dict[str, list[list[Round]]] = field(default_factory=dict)
    origins: list[Origin] = field(default_factory=list)

    @property
    def commits(self) -> str:
        """The commit that was measured, or which subjects were measured on which."""
        subjects: dict[str, dict[str, None]] = {}
        for origin in self.origins:
            subjects.setdefault(origin.commit, {}).update(dict.fromkeys(origin.subjects))
        if len(subjects) < 2:
            return next(iter(subjects), self.versions.get("commit", "unknown"))
        return ", ".join(f"{commit} ({', '.join(names)})" for commit, names in subjects.items())

    @property
    def days(self) -> str:
        """The day on which it was measured, or the first and the last one."""
        days = sorted({each.started[:10] for each in self.origins} or {self.started[:10]})
        return days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"

    @classmethod
    def here(cls, is_quick: bool) -> Results:
        """Empty ones, of this machine and moment."""
        return cls(utc_time(), is_quick, machine(), versions())

    def write(self, file: Path) -> None:
        """Write them to a file."""
        data = {"schema": SCHEMA, **asdict(self)}
        write_whole(file, json.dumps(data, indent=1) + "\n")

    @classmethod
    def read(cls, file: Path) -> Results:
        """Read what :meth:`write` wrote.

        Raises:
            UsageError: if it is no such file, or one of another schema.
        """
        try:
            data: dict[str, Any] = json.loads(file.read_text("utf-8"))
            schema = data.pop("schema")
        except OSError as error:
            raise UsageError(f"{file}: {error.strerror}") from error
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise UsageError(f"{file} is no results file of the benchmarks") from error
        if schema != SCHEMA:
            raise UsageError(f"{file} has schema {schema}; this version reads {SCHEMA}")
        data["rows"] = [Row.from_json(each) for each in data["rows"]]
        data["notices"] = [Notice(**each) for each in data["notices"]]
        data["origins"] = [
            Origin(each["started"], each["commit"], tuple(each["subjects"]))
            for each in data.get("origins", [])
        ]
        return cls(**data)


def combine(parts: Sequence[Results]) -> Results:
    """One result of several runs; of rows that several have, those of the last one."""
    whole = Results(parts[-1].started, any(each.is_quick for each in parts))
    rows: dict[tuple[str, str], Row] = {}
    origins: dict[tuple[str, str], list[Origin]] = {}
    for part in parts:
        whole.machine, whole.versions = part.machine, part.versions
        whole.load_before |= part.load_before
        whole.rounds |= part.rounds
        rows |= {row.key: row for row in part.rows}
        origins |= {row.key: _origins(part, row.subject) for row in part.rows}
        whole.notices += part.notices
    whole.rows = list(rows.values())
    whole.origins = list(dict.fromkeys(chain.from_iterable(origins.values())))
    return whole


def _origins(part: Results, subject: str) -> list[Origin]:
    """Where the rows of a subject may be from: of results that were put together, several runs."""
    one = Origin(part.started, part.versions.get("commit", "unknown"), (subject,))
    found = [each for each in part.origins if subject in each.subjects]
    return [replace(each, subjects=(subject,)) for each in found] or [one]


def differences(a: Results, b: Results) -> list[str]:
    """In what the machines and versions of two runs differ, one line each."""
    both = [(a.machine, b.machine), (a.versions, b.versions)]
    lines = [
        f"{name}: {one.get(name, 'unknown')} and {other.get(name, 'unknown')}"
        for one, other in both
        for name in {**one, **other}
        if one.get(name) != other.get(name)
    ]
    if a.is_quick != b.is_quick:
        lines.append("one of them is a quick run")
    return lines


def write_whole(file: Path, text: str) -> None:
    """Write a file; a reader sees the old or the new one, never a part."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    part.write_text(text, "utf-8")
    os.replace(part, file)


def utc_time() -> str:
    """Now, as a name of a file."""
    return time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime())
