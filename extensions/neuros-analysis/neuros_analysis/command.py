"""``neuros report``, ``compare`` and ``sweep``; ``--help`` and completion read this module, too."""

from __future__ import annotations

import argparse
import contextlib
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.cli.common import JSON, add_format, print_json
from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros.options import add_options, options_of, values_of
from neuros.ordinary_files import write_whole
from neuros_analysis.options import SweepOptions

if TYPE_CHECKING:
    from neuros_analysis.review import ReviewedRun

EXIT_FAILED, EXIT_LEFT_OUT = 1, 2
_PAGE = "report.html"
_SWEEP_EPILOG = """\
exit codes:
  0    all runs ended normally
  1    a run did not; the others were made
  2    wrong usage
  3    the project is invalid with some of the values: nothing was run
  130  ended by Ctrl+C: the runs that had ended are kept, and not run again
"""


def add_report(report: argparse.ArgumentParser) -> None:
    report.description = (
        "Say what limited the speed of a run, and write a page (HTML, one file) with figures, and"
        " the figures themselves (PNG)."
    )
    report.add_argument("run", metavar="RUN", type=Path, help="a run folder, or a bag")
    report.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="where to write (default: RUN/report; of a bag, BAG_report in the current folder)",
    )
    report.set_defaults(command=_report)


def add_compare(compare: argparse.ArgumentParser) -> None:
    compare.description = (
        "Print the numbers of several runs side by side. A folder that is no run folder is named"
        " and left out (exit code 2)."
    )
    compare.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    compare.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write a page (HTML) as well"
    )
    add_format(compare)
    compare.set_defaults(command=_compare)


def _report(options: argparse.Namespace) -> int:
    from neuros_analysis.bag_pages import is_foreign_bag
    from neuros_analysis.findings import findings_of
    from neuros_analysis.review import open_for_review
    from neuros_analysis.run_pages import figures_of, panels_page, report_page, world_pages

    if is_foreign_bag(options.run):
        return _report_bag(options)
    run = open_for_review(options.run)
    folder = options.output or options.run / "report"
    if options.output is None and folder.is_symlink():
        raise EnvironmentFault(f"{folder} is a link to another place: name a place with -o")
    findings = findings_of(run)
    print(findings.headline)
    for line in (*findings.reasons, *findings.gains):
        print(f"  {line}")
    if findings.trial:
        print(f"  To test it: {findings.trial}")
    for line in run.missing:
        print(f"missing: {line}")
    figures = figures_of(run)
    text = report_page(run, findings, {t: (text, data) for t, text, data in figures.values()})
    files = {f"{name}.png": data for name, (_, _, data) in figures.items()}
    found = world_pages(run, lambda text: print(f"missing: {text}"))
    worlds = {f"world_{node}.html": page.encode() for node, page in found.items()}
    try:
        panels = panels_page(run)
    except EnvironmentFault as fault:
        panels = None
        print(f"missing: panels: {fault}")
    pages = {} if panels is None else {"panels.html": panels.encode()}
    whole = {**files, _PAGE: text.encode(), **worlds, **pages}
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in whole.items():
            write_whole(folder / name, data)
    print(f"{folder / _PAGE}: {len(figures)} figures")
    for name in worlds:
        print(f"{folder / name}: the world in 3-D")
    for name in pages:
        print(f"{folder / name}: spikes and activity")
    return 0


def _report_bag(options: argparse.Namespace) -> int:
    """Write the page of a bag of another program."""
    from tabulate import tabulate

    from neuros.bag import open_bag
    from neuros_analysis.bag_pages import HEADER, bag_page, times_of
    from neuros_analysis.run_pages import panels_of

    folder = options.output or Path(f"{options.run.resolve().name}_report")
    with open_bag(options.run) as bag:
        topics = times_of(bag)
        pages = {_PAGE: bag_page(bag, topics)}
        if panels := panels_of(bag, bag.folder.name):
            pages["panels.html"] = panels
        notes = [*bag.notes, *(topic.remark for topic in topics if topic.remark)]
    print(tabulate([topic.row for topic in topics], HEADER, disable_numparse=True))
    for note in notes:
        print(f"note: {note}")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in pages.items():
            write_whole(folder / name, text.encode())
    for name in pages:
        print(folder / name)
    return 0


def _compare(options: argparse.Namespace) -> int:
    from neuros_analysis.comparison import comparison_rows, comparison_table, figures_of, labels_of
    from neuros_analysis.review import open_for_review

    runs: list[ReviewedRun] = []
    refused: list[NeurosError] = []
    for folder in options.runs:
        try:
            runs.append(open_for_review(folder))
        except (UsageError, EnvironmentFault) as error:
            refused.append(error)
    if not runs:
        raise UsageError("\n".join(map(str, refused)))
    header, rows = comparison_rows(runs)
    is_json = options.format == JSON
    if is_json:
        missing = [list(run.missing) for run in runs]
        print_json({"runs": labels_of(runs), "figures": figures_of(runs), "missing": missing})
    else:
        print(comparison_table(header, rows))
        for run, label in zip(runs, labels_of(runs), strict=True):
            for line in run.missing:
                print(f"missing in {label}: {line}")
    if options.output is not None:
        page = _comparison_page(runs, header, rows)
        with writing(options.output.parent):
            options.output.parent.mkdir(parents=True, exist_ok=True)
            options.output.write_bytes(page)
        if not is_json:
            print(options.output)
    for reason in refused:
        print(f"neuros: left out: {reason}", file=sys.stderr)
    return EXIT_LEFT_OUT if refused else 0


def _comparison_page(runs: list[ReviewedRun], header: list[str], rows: list[list[str]]) -> bytes:
    from neuros_analysis.charts import comparison_figure
    from neuros_analysis.comparison import labels_of
    from neuros_analysis.findings import findings_of
    from neuros_analysis.run_pages import bottleneck_part, figure_part, page, picture, table_part

    parts = [
        bottleneck_part(findings_of(run), f"The bottleneck of {label}")
        for run, label in zip(runs, labels_of(runs), strict=True)
    ]
    figure = comparison_figure(runs)
    if figure is not None:
        parts.append(figure_part("Side by side", "", picture(figure)))
    parts.append(table_part("All figures", header, rows))
    return page("Comparison of runs", parts).encode()


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn what fails inside into a sentence. Raises ``EnvironmentFault``."""
    try:
        yield
    except OSError as error:
        raise EnvironmentFault(
            f"{folder} could not be written to ({error.strerror}): name another place with -o"
        ) from error


def add_sweep(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Run a project with every combination of values and seeds, and write one"
        " table (sweep.csv). Runs that have already finished in the same folder are not repeated."
    )
    command.epilog = _SWEEP_EPILOG
    command.add_argument(
        "project", metavar="PROJECT", help="a file, or a folder with a project.json"
    )
    add_options(command, options_of(SweepOptions))
    add_format(command)
    command.set_defaults(command=_sweep)


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """While the block lasts, warnings of projects are written without a line of Python."""

    def warn(message: Warning | str, *_: Any, **__: Any) -> None:
        print(f"warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = warn
        yield


def _sweep(parsed: argparse.Namespace) -> int:
    from neuros_analysis.sweep import CSV_NAME, sweep

    def print_row(number: int, count: int, row: Mapping[str, Any]) -> None:
        values = list(row)[: list(row).index("exit_code")]
        what = ", ".join(f"{name}={row[name]}" for name in values) or "run"
        stream = sys.stderr if is_json else sys.stdout
        print(f"[{number}/{count}] {what}: {row['reason']}", file=stream, flush=True)

    is_json = parsed.format == JSON
    with plain_warnings():
        options = values_of(options_of(SweepOptions), parsed)
        made = sweep(parsed.project, **options, on_row=print_row)
    if is_json:
        print_json({"folder": made.folder, "rows": made.rows})
    else:
        print(f"\n{made}\n\n{made.folder / CSV_NAME}")
    return 0 if all(row["exit_code"] == 0 for row in made.rows) else EXIT_FAILED
