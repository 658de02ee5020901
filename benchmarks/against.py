"""This checkout beside another commit: rounds of both, interleaved, and the ratio of each row.

Figures of different days, or of different hours, differ by more than most changes do. So both
commits are installed side by side, and each round measures one and then the other; every other
round begins with the other one. The subject ``guard``, which counts processor time, is measured on
both at the same time, each on a core, which they exchange after each round.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from tabulate import tabulate

from benchmarks.intervals import Summary
from benchmarks.machine import ROOT
from benchmarks.processes import cores
from benchmarks.table import number, summary_text
from neuros.errors import EnvironmentFault, UsageError

ROUNDS, QUICK_ROUNDS = 10, 6
LANDED = "landed"
"""For the last commit that has landed."""
GUARD = "guard"
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
        commit: ``LANDED`` for the last one that has landed (:func:`landed`).
        rows: only rows whose names contain this.
        rounds: of each commit (default: 10, or 6 if quick).

    Returns:
        The rows that both commits have.

    Raises:
        UsageError: if there is no such commit.
        EnvironmentFault: if it cannot be installed, or a measurement fails.
    """
    other = installed(landed() if commit == LANDED else commit, say)
    if lacking := [name for name in subjects if not _has_subject(other, name)]:
        say(f"{other.name} does not have {', '.join(lacking)}: there is nothing to compare with")
        return []
    count = rounds or (QUICK_ROUNDS if is_quick else ROUNDS)
    arguments = [*subjects, *(["-k", rows] if rows else []), *(["--quick"] if is_quick else [])]
    found: dict[tuple[str, str], tuple[list[float], list[float]]] = {}
    for number_ in range(count):
        sides = [1, 0] if number_ % 2 else [0, 1]
        say(f"round {number_ + 1} of {count}")
        measured = _at_once if [*subjects] == [GUARD] and len(cores()) > 1 else _in_turn
        for side, results in measured(sides, (ROOT, other), arguments):
            for row in results:
                key = f"{row['subject']}: {row['name']}", row["unit"]
                found.setdefault(key, ([], []))[side].append(row["values"][0])
    return [
        Pair(name, unit, tuple(here), tuple(there))
        for (name, unit), (here, there) in found.items()
        if len(here) == len(there)
    ]


def landed() -> str:
    """The last commit on the main branch: of ``origin``, or before the one that is checked out.

    Raises:
        UsageError: if there is neither.
    """
    here = _git("rev-parse", "HEAD")
    with contextlib.suppress(UsageError):
        if (base := _git("merge-base", "HEAD", "origin/main")) != here:
            return base.decode().strip()
    return "HEAD^1"


def installed(commit: str, say: Callable[[str], None]) -> Path:
    """The folder with a commit, which is kept for the next time.

    It has a ``.venv`` of its own if it requires other packages than this one.
    """
    named = _git("rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}").decode().strip()
    folder = ROOT / "build" / "benchmarks" / "commits" / named[:12]
    complete = folder / ".complete"
    if not complete.is_file():
        say(f"putting {named[:12]} into {folder}")
        with tarfile.open(fileobj=BytesIO(_git("archive", named))) as archive:
            archive.extractall(folder)
        if requirements(folder) != requirements(ROOT):
            say("it requires other packages: installing them")
            command = [sys.executable, "install.py", "-y", "--no-containers"]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode:
                raise EnvironmentFault(f"{named[:12]} cannot be installed: {done.stdout[-500:]}")
        complete.touch()
    return folder


def requirements(tree: Path) -> dict[str, str]:
    """All that decides what an installation of a checkout consists of, its own code aside."""
    own = ("requirements/*.txt", "pyproject.toml", "neuros/entry_points.txt")
    of_extensions = ("extensions/*/pyproject.toml", "extensions/*/*/entry_points.txt")
    files = [file for pattern in (*own, *of_extensions) for file in tree.glob(pattern)]
    return {
        str(file.relative_to(tree)): file.read_text("utf-8").partition("\n[tool.")[0]
        for file in sorted(files)
    }


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


def _in_turn(
    sides: Sequence[int], trees: Sequence[Path], arguments: Sequence[str]
) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """What each side measures in a round, one after the other."""
    for side in sides:
        yield side, _rows(trees[side], arguments)


def _at_once(
    sides: Sequence[int], trees: Sequence[Path], arguments: Sequence[str]
) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """The same where processor time is measured: each has a core, and others disturb both alike."""
    with ThreadPoolExecutor(len(sides)) as pool:
        jobs = {
            side: pool.submit(_rows, trees[side], arguments, ("taskset", "-c", str(core)))
            for side, core in zip(sides, cores(), strict=False)
        }
        for side, job in jobs.items():
            yield side, job.result()


def _has_subject(tree: Path, name: str) -> bool:
    return (tree / "benchmarks" / "subjects" / f"{name}.py").is_file()


def _rows(tree: Path, arguments: Sequence[str], prefix: Sequence[str] = ()) -> list[dict[str, Any]]:
    """What one round in a checkout measures."""
    own = tree / ".venv" / "bin" / "python"
    packages = [tree, *tree.glob("extensions/*/")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, packages))}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "results.json"
        python = str(own) if own.is_file() else sys.executable
        command = [*prefix, python, "-m", "benchmarks", *arguments, "--rounds", "1"]
        done = subprocess.run(
            [*command, "-o", str(file)],
            cwd=tree,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if not file.is_file():
            raise EnvironmentFault(f"{tree}: nothing was measured: {done.stderr[-500:]}")
        results: list[dict[str, Any]] = json.loads(file.read_text("utf-8"))["rows"]
        return results


def _git(*arguments: str) -> bytes:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, check=False)
    if done.returncode:
        text = done.stderr.decode(errors="replace").strip() or "there is no such commit"
        raise UsageError(f"--against: {text}")
    return done.stdout
