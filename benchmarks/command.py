"""What ``neuros benchmark`` does, after its options were read (:mod:`benchmarks.options`)."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from tabulate import tabulate

from benchmarks import against, page, running, subjects
from benchmarks.interruption import interrupted_by_termination
from benchmarks.machine import ROOT
from benchmarks.measure import Subject
from benchmarks.results import Results, utc_time
from benchmarks.table import LEGEND, notice_lines, rows_table, targets_table
from benchmarks.targets import TARGETS
from neuros.errors import UsageError

FOLDER = ROOT / "build" / "benchmarks"


def run(options: argparse.Namespace) -> int:
    """Run the command; returns its exit code.

    Raises:
        UsageError: for a name or a file that does not exist.
    """
    if options.list:
        print(_list())
        return 0
    if options.against:
        pairs = against.measure(
            options.against,
            options.subjects,
            _say,
            rows=options.rows,
            rounds=options.rounds,
            is_quick=options.quick,
        )
        print(against.table(pairs) if pairs else "nothing was compared")
        return int(any(pair.verdict == "slower" for pair in pairs))
    if options.file:
        results, code = Results.read(Path(options.file)), 0
    else:
        results, code = _measure(options)
    print(_report(results, is_whole=not (options.subjects or options.rows)))
    if options.write_docs:
        page.write(results, ROOT / "docs")
    return code


def _measure(options: argparse.Namespace) -> tuple[Results, int]:
    chosen = subjects.load(options.subjects, options.quick)
    if options.rows:
        chosen = _only(chosen, options.rows)
    results, code = Results.here(options.quick), 0
    file = Path(options.output) if options.output else FOLDER / f"{utc_time()}.json"
    try:
        with interrupted_by_termination():
            running.measure(chosen, results, file, _say, options.rounds)
    except KeyboardInterrupt:
        _say("interrupted: what was measured is kept")
        code = 130
    _say(f"all values: {file}")
    return results, code or int(any(notice.is_failure for notice in results.notices))


def _only(chosen: dict[str, Subject], text: str) -> dict[str, Subject]:
    """The parts of subjects that are needed for rows whose names contain ``text``."""
    parts = {}
    for name, subject in chosen.items():
        groups = tuple(part for part in (each.only(text) for each in subject.groups) if part.cases)
        if groups:
            parts[name] = replace(subject, groups=groups)
    if not parts:
        raise UsageError(f"-k {text}: no row of {', '.join(chosen)} has that in its name")
    return parts


def _list() -> str:
    cells = []
    for name, subject in subjects.load([], is_quick=False).items():
        rows = sum(len(group.cases) for group in subject.groups)
        held = sum(target.subject == name for target in TARGETS)
        cells.append([name, rows, held or "", subject.description])
    return tabulate(cells, headers=["subject", "rows", "targets", "what is measured"])


def _report(results: Results, is_whole: bool) -> str:
    """The tables; of a part, only the targets that it is about."""
    parts = [rows_table(results.rows)]
    if is_whole or any(row.bound for row in results.rows):
        parts.append(targets_table(results.rows, is_whole=is_whole))
    parts.append(LEGEND)
    parts += ["\n".join(notice_lines(results.notices))] if results.notices else []
    about = results.machine | results.versions
    parts.append(", ".join(f"{name} {value}" for name, value in about.items()))
    loads = ", ".join(f"{name} {load:.0%}" for name, load in results.load_before.items())
    parts.append(f"busy with other things before: {loads}")
    if results.is_quick:
        parts.append("A quick run: it shows that everything works; its figures mean nothing.")
    return "\n\n".join(parts)


def _say(line: str) -> None:
    """Show progress."""
    print(line, file=sys.stderr, flush=True)
