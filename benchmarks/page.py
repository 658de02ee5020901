"""The part of docs/numbers.md that is generated: tables, and what was measured on."""

from __future__ import annotations

from pathlib import Path

from benchmarks.results import Results
from benchmarks.table import LEGEND, notice_lines, rows_table, symbols, targets_table
from neuros.errors import UsageError

BEGIN, END = "<!-- generated: begin -->", "<!-- generated: end -->"


def write(results: Results, docs: Path) -> None:
    """Put the results between the markers of ``numbers.md``.

    Raises:
        UsageError: if the page has no markers, or the files that were measured are of no commit.
    """
    if results.versions.get("commit", "unknown").endswith(("+", "unknown")):
        raise UsageError("--write-docs: commit first: the page names the commit of its figures")
    page = docs / "numbers.md"
    before, begin, rest = page.read_text("utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise UsageError(f"{page} has no lines {BEGIN} and {END}")
    page.write_text(f"{before}{BEGIN}\n\n{generated(results)}\n\n{END}{after}", "utf-8")


def generated(results: Results) -> str:
    """The text between the markers."""
    parts = [
        "### Targets",
        symbols(targets_table(results.rows, "pipe")),
        LEGEND,
        "### Everything",
        _by_subject(results),
        "### Measured on",
        _about(results),
    ]
    if results.notices:
        parts.append("\n".join(f"- {line}" for line in notice_lines(results.notices)))
    return "\n\n".join(parts)


def _by_subject(results: Results) -> str:
    """One table per subject, with what it was measured on."""
    commit, machine = results.versions["commit"], results.machine
    on = f"{results.started[:10]}, {machine['cores']} cores of {machine['processor']}, {commit}"
    parts = []
    for subject in dict.fromkeys(row.subject for row in results.rows):
        rows = [row for row in results.rows if row.subject == subject]
        parts += [f"`neuros benchmark {subject}` ({on})", symbols(rows_table(rows, "pipe"))]
    return "\n\n".join(parts)


def _about(results: Results) -> str:
    machine, versions = results.machine, results.versions
    loads = ", ".join(f"{name} {load:.0%}" for name, load in results.load_before.items())
    others = ", ".join(f"{name} {version}" for name, version in versions.items())
    text = (
        f"{results.started[:10]}, {machine['cores']} cores of {machine['processor']},"
        f" {machine['system']}; {others}. Others kept this share of the cores busy in the second"
        f" before each subject: {loads}."
    )
    return f"A quick run: its figures mean nothing. {text}" if results.is_quick else text
