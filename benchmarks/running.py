"""Measuring subjects one after the other, with everything kept as soon as it is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from benchmarks.machine import load_before
from benchmarks.measure import Run, Subject
from benchmarks.results import Notice, Results
from benchmarks.rows import row_of

QUICK_ROUNDS = 2


def measure(
    subjects: Mapping[str, Subject],
    results: Results,
    file: Path | None,
    say: Callable[[str], None],
    rounds: int | None = None,
) -> None:
    """Measure the subjects into ``results``; Ctrl+C leaves there what was measured before.

    Args:
        file: where the results are written after each measurement, or ``None``.
        say: shows a line of progress.
        rounds: instead of those of the groups.
    """
    for name, subject in subjects.items():
        results.load_before[name] = load_before(0.2 if results.is_quick else 1.0)
        say(f"{name} (others keep {results.load_before[name]:.0%} of the cores busy)")
        runs = [Run(group) for group in subject.groups]
        before = replace(results, rows=list(results.rows), notices=list(results.notices))
        for run in runs:
            say(f" {'; '.join(case.name for case in run.group.cases)}")
            usual = QUICK_ROUNDS if results.is_quick else run.group.rounds
            for _ in run.measure(rounds or usual, say):
                _gather(name, runs, before, results)
                if file is not None:
                    results.write(file)


def _gather(name: str, runs: list[Run], before: Results, results: Results) -> None:
    """Put what the groups of a subject have measured so far behind what was there before."""
    results.rounds[name] = [run.rounds for run in runs]
    rows = [row_of(name, case, run.rounds) for run in runs for case in run.group.cases]
    results.rows = before.rows + [row for row in rows if row is not None]
    results.notices = before.notices + [each for run in runs for each in _notices(name, run)]


def _notices(name: str, run: Run) -> list[Notice]:
    reasons = {candidate: (reason, False) for candidate, reason in run.unavailable.items()}
    for candidate, failures in run.failures.items():
        reasons[candidate] = (f"{candidate} failed {len(failures)} x: {failures[-1]}", True)
    return [
        Notice(name, case.name, reason, is_failure)
        for case in run.group.cases
        for candidate, (reason, is_failure) in reasons.items()
        if candidate in case.candidates
    ]
