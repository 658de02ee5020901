"""An experiment on disk: which runs were made, on what, and which of them failed.

::

    build/reproduce/<experiment>/<utc time>/     or what -o names
        reproduce.json                           this record, written after each run
        runs/<name>-<number>/                    what each run left behind
        tables/, figures/, index.md              made of it, and made anew by --from
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.machine import machine, versions
from benchmarks.results import utc_time, write_whole
from neuros.errors import UsageError

FILE, FORMAT = "reproduce.json", 1


@dataclass(frozen=True)
class Entry:
    """One run.

    Attributes:
        load_before: share of all cores that others kept busy just before.
        unix_minus_monotonic_s: what turns the times of packets into those of ``system_load.csv``.
        failure: what went wrong; empty if nothing did.
    """

    name: str
    number: int
    load_before: float
    unix_minus_monotonic_s: float
    failure: str = ""

    @property
    def title(self) -> str:
        """``strict-1``: also the name of its folder."""
        return f"{self.name}-{self.number}"


@dataclass
class Experiment:
    """All of it.

    Attributes:
        duration_s: of each run; simulated seconds where there is simulated time.
    """

    folder: Path
    name: str
    duration_s: float
    started: str
    machine: dict[str, str]
    versions: dict[str, str]
    runs: list[Entry] = field(default_factory=list)

    @classmethod
    def begin(cls, folder: Path, name: str, duration_s: float) -> Experiment:
        """A new one, or the one in the folder, so that runs can be added to it.

        Raises:
            UsageError: if the folder holds something else, or cannot be written to.
        """
        now = cls(folder, name, duration_s, utc_time(), machine(), versions())
        if (folder / FILE).exists():
            there = cls.open(folder, name)
            if different := _differences(there, now):
                raise UsageError(
                    f"{folder} holds runs that these must not be mixed with ({different}):"
                    " name another folder with -o"
                )
            return there
        try:
            if folder.is_dir() and os.listdir(folder):
                raise UsageError(f"-o {folder}: holds something else; name a new folder")
            folder.mkdir(parents=True, exist_ok=True)
            now.write()
        except OSError as error:
            raise UsageError(
                f"{folder} cannot be written to ({error.strerror}): name another folder with -o"
            ) from error
        return now

    @classmethod
    def open(cls, folder: Path, name: str) -> Experiment:
        """Read the record. Raises ``UsageError`` where there is none of this experiment."""
        file = folder / FILE
        try:
            data: dict[str, Any] = json.loads(file.read_text("utf-8"))
            found = data.pop("format"), data["name"]
            if found != (FORMAT, name):
                raise UsageError(
                    f"{file}: is format {found[0]} of experiment {found[1]}, not {FORMAT} of {name}"
                )
            data["runs"] = [Entry(**each) for each in data["runs"]]
            return cls(folder=folder, **data)
        except OSError as error:
            raise UsageError(
                f"{folder} is no folder of `neuros reproduce {name}`: {file} cannot be read"
                f" ({error.strerror})"
            ) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(f"{file} is broken ({error})") from error

    def write(self) -> None:
        """Write the record."""
        data = {"format": FORMAT, **asdict(self)}
        del data["folder"]
        write_whole(self.folder / FILE, json.dumps(data, indent=2) + "\n")

    def run_folder(self, entry: Entry) -> Path:
        """Where a run left its files."""
        return self.folder / "runs" / entry.title

    def next_number(self, name: str) -> int:
        """Of the next run of that name; a folder of an interrupted run is not used again."""
        number = 1 + max((each.number for each in self.runs if each.name == name), default=0)
        while (self.folder / "runs" / f"{name}-{number}").exists():
            number += 1
        return number


def _differences(there: Experiment, now: Experiment) -> str:
    """In what two experiments differ, apart from their runs; empty if in nothing."""
    then, today = (
        {"duration": f"{each.duration_s:g} s", **each.machine, **each.versions}
        for each in (there, now)
    )
    return "; ".join(
        f"{key} there {then.get(key)}, now {today.get(key)}"
        for key in {**then, **today}
        if then.get(key) != today.get(key)
    )
