"""Commands about runs that are over: ``report``, ``compare``, ``verify`` and ``bag``."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.cli.common import JSON, add_format, print_json
from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros.ordinary_files import write_whole
from neuros.project.suggest import counted

if TYPE_CHECKING:
    from neuros.analysis.run_record import PastRun

EXIT_DIFFERENT = 1
EXIT_UNKNOWN = EXIT_LEFT_OUT = 2
EXIT_DAMAGED = 4
EXIT_CONSUMED = 6
_PAGE = "report.html"


def add_report(report: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    report.description = (
        "Say what limited the speed of a run, and write a page (HTML, one file) with figures, and"
        " the figures themselves (PNG)."
    )
    report.add_argument("run", metavar="RUN", type=Path, help="a run folder")
    report.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="where to write (default: RUN/report)"
    )
    report.set_defaults(command=_report)


def add_compare(compare: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
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
    from neuros.analysis.findings import findings_of
    from neuros.analysis.run_pages import panels_page, report_page, world_pages
    from neuros.analysis.run_record import open_for_review

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
    figures = _figures(run)
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
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in whole.items():
            write_whole(folder / name, data)
    print(f"{folder / _PAGE}: {len(figures)} figures")
    for name in worlds:
        print(f"{folder / name}: the world in 3-D")
    for name in pages:
        print(f"{folder / name}: spikes and activity")
    return 0


def _figures(run: PastRun) -> dict[str, tuple[str, str, bytes]]:
    from neuros.analysis.run_pages import figures_of

    try:
        return figures_of(run)
    except ModuleNotFoundError as error:
        raise _no_matplotlib(error) from error


def _compare(options: argparse.Namespace) -> int:
    from neuros.analysis.comparison import comparison_rows, comparison_table, figures_of, labels_of

    runs, refused = _readable(options.runs)
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
        page = _comparison(runs, header, rows)
        with _writing(options.output.parent):
            options.output.parent.mkdir(parents=True, exist_ok=True)
            options.output.write_bytes(page)
        if not is_json:
            print(options.output)
    for error in refused:
        print(f"neuros: left out: {error}", file=sys.stderr)
    return EXIT_LEFT_OUT if refused else 0


def _readable(folders: Sequence[Path]) -> tuple[list[PastRun], list[NeurosError]]:
    """The runs that can be shown, and why the others cannot. Raises ``UsageError`` if none can."""
    from neuros.analysis.run_record import open_for_review

    runs: list[PastRun] = []
    refused: list[NeurosError] = []
    for folder in folders:
        try:
            runs.append(open_for_review(folder))
        except (UsageError, EnvironmentFault) as error:
            refused.append(error)
    if not runs:
        raise UsageError("\n".join(map(str, refused)))
    return runs, refused


def _comparison(runs: list[PastRun], header: list[str], rows: list[list[str]]) -> bytes:
    from neuros.analysis.comparison import comparison_figure, labels_of
    from neuros.analysis.findings import findings_of
    from neuros.analysis.run_pages import bottleneck_part, figure_part, page, png, table_part

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
        f"figures need {error.name}, which is not installed: pip install 'neuros[plot]'"
    )


@contextlib.contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise EnvironmentFault(
            f"{folder} could not be written to ({error.strerror}): name another place with -o"
        ) from error


def add_verify(verify: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    verify.description = (
        "Say whether two runs carried the same packets. If not, name the first difference:"
        " connection, packet and, if both runs were recorded, field. For a run that was started"
        " in parts, name a folder that holds the run folders of all parts."
    )
    verify.epilog = (
        "exit codes: 0 identical, 1 different, 2 nothing to compare, 6 the same packets were sent,"
        " but hooks took others of them"
    )
    verify.add_argument("run_a", metavar="RUN_A", type=Path, help="a run folder")
    verify.add_argument("run_b", metavar="RUN_B", type=Path, help="another one")
    add_format(verify)
    verify.set_defaults(command=_verify)


def _verify(options: argparse.Namespace) -> int:
    from neuros.analysis.comparison import RecordedPackets, compare
    from neuros.analysis.run_record import open_whole

    a, b = open_whole(options.run_a), open_whole(options.run_b)
    recorded = RecordedPackets()
    verdict = compare(a, b, recorded)
    remarks = [*recorded.remarks, *verdict.remarks]
    packets = counted(verdict.compared, "packet")
    result, exit_code, what = "identical", 0, packets
    if verdict.difference is not None:
        result, exit_code, what = "different", EXIT_DIFFERENT, verdict.difference
    elif not verdict.compared and verdict.remarks:
        result, exit_code, what = "unknown", EXIT_UNKNOWN, "there is nothing to compare"
    elif taken := verdict.consumed_differently:
        result, exit_code = "sent packets identical", EXIT_CONSUMED
        what = f"{packets}; {_were(taken)} consumed differently"
    if verdict.not_compared and exit_code in (0, EXIT_CONSUMED):
        what += f"; {_were(verdict.not_compared)} not compared, or not whole"
    if options.format == JSON:
        print_json(
            {
                "verdict": result,
                "packets": verdict.compared,
                "difference": verdict.difference,
                "consumed_differently": verdict.consumed_differently,
                "not_compared": verdict.not_compared,
                "notes": remarks,
            }
        )
        return exit_code
    for remark in remarks:
        print(f"note: {remark}")
    print(f"{result}: {what}")
    return exit_code


def _were(connections: Sequence[str]) -> str:
    verb = "was" if len(connections) == 1 else "were"
    return f"{counted(len(connections), 'connection')} {verb}"


def add_bag(bag: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bag.description = "Show what a run has recorded, or complete the bag of a run that was cut off."
    actions = bag.add_subparsers(title="actions", metavar="ACTION", required=True)
    info = actions.add_parser("info", help="show the topics of a bag")
    info.add_argument("run", metavar="RUN", help="the run folder, or a bag")
    info.set_defaults(command=_info)
    repair = actions.add_parser(
        "repair",
        help="complete the bag of a run that was killed",
        description="Add the packets that had not reached the bag, and complete its files.",
    )
    repair.add_argument("run", metavar="RUN", help="the run folder")
    repair.add_argument(
        "--keep-changed",
        action="store_true",
        help="keep packets that may have changed, since a checksum is wrong",
    )
    repair.set_defaults(command=_repair)


def _info(options: argparse.Namespace) -> int:
    from tabulate import tabulate

    from neuros.bag import open_bag

    with open_bag(options.run) as opened:
        rows = [[t.name, t.type, t.count] for t in opened.topics.values()]
        print(tabulate(rows, headers=["topic", "type", "packets"], disable_numparse=True))
        print(f"\n{opened.folder}: {opened.duration_s:.2f} s, project {opened.project or '?'}")
        damage = opened.check()
    if damage is None:
        return 0
    print(f"neuros: {damage}", file=sys.stderr)
    return EXIT_DAMAGED


def _repair(options: argparse.Namespace) -> int:
    from neuros.recording.recorder import KEPT_NAME, named, repair

    def complain(text: str) -> None:
        print(f"neuros: {text}", file=sys.stderr)

    repaired = repair(Path(options.run), complain, keeps_changed=options.keep_changed)
    if repaired is None:
        print(f"{options.run}: the bag is complete")
        return 0
    counts = repaired.counts
    print(f"{options.run}: completed, {sum(counts.values())} packets on {len(counts)} topics")
    if repaired.changed:
        what = "kept" if options.keep_changed else f"left out: {KEPT_NAME} has them"
        complain(f"{repaired.changed} packets, any of which may have changed, are {what}")
    if repaired.lost:
        complain(f"packets that were recorded, and are not in the bag: {named(repaired.lost)}")
    return EXIT_DAMAGED if repaired.changed or repaired.lost else 0
