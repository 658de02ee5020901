"""``neuros report`` and ``neuros compare``: what runs were like, in words and pictures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.errors import EnvironmentFault, UsageError

if TYPE_CHECKING:
    from neuros.observe.review.run import Run

EXIT_LEFT_OUT = 2
_PAGE = "report.html"


def add_report(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands."""
    report = commands.add_parser(
        "report",
        help="what limited a run, and figures of it",
        description="Say what limited the speed of a run, and write a page (HTML, one file) with"
        " figures, and the figures themselves (PNG).",
    )
    report.add_argument("run", metavar="RUN", type=Path, help="a run folder")
    report.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="where to write (default: RUN/report)"
    )
    report.set_defaults(command=_report)
    compare = commands.add_parser(
        "compare",
        help="runs side by side",
        description="Print the figures of several runs side by side. What is no run is named and"
        " left out (exit code 2).",
    )
    compare.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    compare.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write a page (HTML) as well"
    )
    compare.set_defaults(command=_compare)


def _report(options: argparse.Namespace) -> int:
    from neuros.observe.review.findings import findings_of
    from neuros.observe.review.page import report_page
    from neuros.observe.review.run import open_for_review

    run = open_for_review(options.run)
    findings = findings_of(run)
    print(findings.headline)
    for line in (*findings.reasons, *findings.gains):
        print(f"  {line}")
    if findings.trial:
        print(f"  To test it: {findings.trial}")
    for line in run.missing:
        print(f"missing: {line}")
    figures = _figures(run)
    folder = options.output or options.run / "report"
    text = report_page(run, findings, {t: (text, data) for t, text, data in figures.values()})
    files = {f"{name}.png": data for name, (_, _, data) in figures.items()}
    _write(folder, {**files, _PAGE: text.encode()})
    print(f"{folder / _PAGE}: {len(figures)} figures")
    return 0


def _figures(run: Run) -> dict[str, tuple[str, str, bytes]]:
    from neuros.observe.review.page import figures_of

    try:
        return figures_of(run)
    except ModuleNotFoundError as error:
        raise _no_matplotlib(error) from error


def _compare(options: argparse.Namespace) -> int:
    from neuros.observe.review.comparison import comparison_rows, comparison_table, labels_of

    runs, refused = _readable(options.runs)
    header, rows = comparison_rows(runs)
    print(comparison_table(header, rows))
    for run, label in zip(runs, labels_of(runs), strict=True):
        for line in run.missing:
            print(f"missing in {label}: {line}")
    if options.output is not None:
        _write(options.output.parent, {options.output.name: _comparison(runs, header, rows)})
        print(options.output)
    for error in refused:
        print(f"neuros: left out: {error}", file=sys.stderr)
    return EXIT_LEFT_OUT if refused else 0


def _readable(folders: Sequence[Path]) -> tuple[list[Run], list[UsageError]]:
    """The runs that can be shown, and why the others cannot. Raises ``UsageError`` if none can."""
    from neuros.observe.review.run import open_for_review

    runs, refused = [], []
    for folder in folders:
        try:
            runs.append(open_for_review(folder))
        except UsageError as error:
            refused.append(error)
    if not runs:
        raise UsageError("\n".join(map(str, refused)))
    return runs, refused


def _comparison(runs: list[Run], header: list[str], rows: list[list[str]]) -> bytes:
    from neuros.observe.review.comparison import comparison_figure, labels_of
    from neuros.observe.review.findings import findings_of
    from neuros.observe.review.page import bottleneck_part, figure_part, page, png, table_part

    parts = [
        bottleneck_part(findings_of(run), f"The bottleneck of {label}")
        for run, label in zip(runs, labels_of(runs), strict=True)
    ]
    try:
        figure = comparison_figure(runs)
    except ModuleNotFoundError as error:
        raise _no_matplotlib(error) from error
    if figure is not None:
        parts.append(figure_part("Side by side", "", png(figure)))
    parts.append(table_part("All figures", header, rows))
    return page("Comparison of runs", parts).encode()


def _no_matplotlib(error: ModuleNotFoundError) -> EnvironmentFault:
    return EnvironmentFault(
        f"figures need {error.name}, which this Python has not: pip install 'neuros[plot]'"
    )


def _write(folder: Path, files: dict[str, bytes]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        raise EnvironmentFault(
            f"{folder} could not be written to ({error.strerror}): name another place with -o"
        ) from error
