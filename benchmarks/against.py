"""This checkout beside another commit: rounds of both, interleaved, and the ratio of each row.

Figures of different days, or of different hours, differ by more than most changes do. So both
commits are installed side by side, and each round measures one and then the other; every other
round begins with the other one.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from tabulate import tabulate

from benchmarks.intervals import Summary
from benchmarks.machine import ROOT
from benchmarks.table import number, summary_text
from neuros.errors import EnvironmentFault, UsageError

ROUNDS, QUICK_ROUNDS = 10, 6
MOST = 1.05
"""A row is slower if the whole interval of its ratio lies above this."""
RATES = ("1/s", "MB/s")
HEADERS = ["measurement", "here", "there", "here / there (95 %)", ""]


@dataclass(frozen=True)
class Pair:
    """A row as both commits have measured it, round by round."""

    name: str
    unit: str
    here: tuple[float, ...]
    there: tuple[float, ...]

    @property
    def ratio(self) -> Summary:
        """Of the value here to the value there; for rates, the other way round: more is slower."""
        pairs = zip(self.here, self.there, strict=True)
        if self.unit in RATES:
            return Summary.of([there / here for here, there in pairs if here])
        return Summary.of([here / there for here, there in pairs if there])

    @property
    def verdict(self) -> str:
        """``slower``, ``faster``, or nothing where the difference is within the noise."""
        interval = self.ratio.interval
        if interval is None or not self.unit:  # a share may be good or bad
            return ""
        return "slower" if interval.low > MOST else "faster" if interval.high < 1 / MOST else ""


def measure(
    commit: str,
    subjects: Sequence[str],
    say: Callable[[str], None],
    *,
    rows: str = "",
    rounds: int | None = None,
    is_quick: bool = False,
) -> list[Pair]:
    """Measure the rows of some subjects here and in another commit.

    Args:
        rows: only rows whose names contain this.
        rounds: of each commit (default: 10, or 6 if quick).

    Raises:
        UsageError: if there is no such commit.
        EnvironmentFault: if it cannot be installed, or a measurement fails.
    """
    other = installed(commit, say)
    count = rounds or (QUICK_ROUNDS if is_quick else ROUNDS)
    options = [*(["-k", rows] if rows else []), *(["--quick"] if is_quick else [])]
    found: dict[tuple[str, str], tuple[list[float], list[float]]] = {}
    for number_ in range(count):
        trees = [(0, ROOT), (1, other)]
        for side, tree in reversed(trees) if number_ % 2 else trees:
            say(f"round {number_ + 1}/{count}, {'there' if side else 'here'}")
            for row in _rows(tree, [*subjects, *options]):
                key = f"{row['subject']}: {row['name']}", row["unit"]
                found.setdefault(key, ([], []))[side].append(row["values"][0])
    return [
        Pair(name, unit, tuple(here), tuple(there))
        for (name, unit), (here, there) in found.items()
        if len(here) == len(there)
    ]


def installed(commit: str, say: Callable[[str], None]) -> Path:
    """The folder with a commit and its own ``.venv``, which is kept for the next time."""
    named = _git("rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}").decode().strip()
    folder = ROOT / "build" / "benchmarks" / "commits" / named[:12]
    if not (folder / ".venv" / "installed").is_file():
        say(f"installing {named[:12]} into {folder}")
        with tarfile.open(fileobj=BytesIO(_git("archive", named))) as archive:
            archive.extractall(folder)
        command = [sys.executable, "install.py", "-y", "--no-containers"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise EnvironmentFault(f"{named[:12]} cannot be installed: {done.stdout[-500:]}")
        (folder / ".venv" / "installed").touch()
    return folder


def table(pairs: Sequence[Pair]) -> str:
    """A line per row."""
    cells = [
        [
            each.name,
            f"{number(Summary.of(each.here).median)} {each.unit}".strip(),
            f"{number(Summary.of(each.there).median)} {each.unit}".strip(),
            summary_text(each.ratio),
            each.verdict,
        ]
        for each in pairs
    ]
    return tabulate(cells, headers=HEADERS, disable_numparse=True)


def _rows(tree: Path, arguments: Sequence[str]) -> Iterator[dict[str, Any]]:
    """What one round in a checkout measures."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "results.json"
        python = str(tree / ".venv" / "bin" / "python")
        command = [python, "-m", "benchmarks", *arguments, "--rounds", "1", "-o", str(file)]
        done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
        if not file.is_file():
            raise EnvironmentFault(f"{tree}: nothing was measured: {done.stderr[-500:]}")
        yield from json.loads(file.read_text("utf-8"))["rows"]


def _git(*arguments: str) -> bytes:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, check=False)
    if done.returncode:
        text = done.stderr.decode(errors="replace").strip() or "there is no such commit"
        raise UsageError(f"--against: {text}")
    return done.stdout
