"""The results file: rows, every single value, and what they were measured on.

It is written anew after each measurement, so that whatever ends a run, what was measured is kept.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.machine import machine, versions
from benchmarks.measure import Round
from benchmarks.rows import Row
from neuros.errors import UsageError

SCHEMA = 3


@dataclass(frozen=True)
class Notice:
    """A row that was not measured, or not in every round, and why."""

    subject: str
    row: str
    reason: str
    is_failure: bool


@dataclass
class Results:
    """All that one run of the benchmarks found out.

    Attributes:
        load_before: by subject, the share of all cores that others kept busy just before.
        rounds: by subject, what each round of each group measured: candidate, figure, value.
    """

    started: str = ""
    is_quick: bool = False
    machine: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    load_before: dict[str, float] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)
    rounds: dict[str, list[list[Round]]] = field(default_factory=dict)

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
        return cls(**data)


def write_whole(file: Path, text: str) -> None:
    """Write a file; a reader sees the old or the new one, never a part."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    part.write_text(text, "utf-8")
    os.replace(part, file)


def utc_time() -> str:
    """Now, as a name of a file."""
    return time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime())
