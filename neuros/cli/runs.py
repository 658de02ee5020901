"""Commands about runs: ``ps``, ``stop``, ``report``, ``compare``, ``verify`` and ``bag``."""

from __future__ import annotations

import argparse
import pwd
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.backends.sessions import Session, sessions
from neuros.backends.shared_memory import remove_dead_runs
from neuros.cli.output import JSON, add_format, print_json
from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros.project.suggest import listed

if TYPE_CHECKING:
    from neuros.analysis.run_record import PastRun

EXIT_DIFFERENT = 1
EXIT_UNKNOWN = EXIT_LEFT_OUT = 2
EXIT_DAMAGED = 4
_PAGE = "report.html"
_SHOWN = 8  # digits of a run's id
_AGAIN_S = 10.0  # nodes have 5 s to drain and 5 s to finalise; then they are killed
_GIVE_UP_S = 30.0
_POLL_S = 0.05
_FILTERS = ("run", "project", "node", "backend", "state")


def add_ps(ps: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    ps.description = (
        "Show the nodes of all runs of this user on this machine; for root, of all users."
    )
    ps.add_argument("-q", "--quiet", action="store_true", help="only the ids of runs")
    ps.add_argument(
        "-f",
        "--filter",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="show only nodes with this value; KEY is run, project, node, backend or state"
        " (repeatable)",
    )
    add_format(ps)
    ps.set_defaults(command=_ps)


def add_stop(stop: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    stop.description = (
        "Stop runs of this user, as Ctrl+C in their terminal does, and wait until they have ended."
        " Root can stop a run of another user, but only by its id."
    )
    stop.add_argument(
        "runs",
        nargs="*",
        metavar="RUN",
        help="the id that `neuros ps` shows (its first digits are enough), or the name of a"
        " project; not needed if there is only one run",
    )
    stop.add_argument("--all", action="store_true", help="stop all runs of this user")
    stop.set_defaults(command=_stop)


@dataclass(frozen=True)
class _RunningNode:
    """A row of ``neuros ps``."""

    run: str
    user: str
    project: str
    node: str
    backend: str
    since: float
    state: str
    folder: str


def _ps(options: argparse.Namespace) -> int:
    found = sessions()
    wanted = [_filter(text) for text in options.filter]
    rows = [
        row
        for session in found
        for row in _rows(session)
        if all(getattr(row, key).startswith(value) for key, value in wanted)
    ]
    if options.quiet:
        for run in dict.fromkeys(row.run for row in rows):
            print(run[:_SHOWN])
    elif options.format == JSON:
        print_json(rows)
    elif not rows:
        print("no running node matches" if found else "nothing is running")
    else:
        print(_table(rows, shows_users=not all(session.is_own for session in found)))
    return 0


def _filter(text: str) -> tuple[str, str]:
    key, separator, value = text.partition("=")
    if not separator or key not in _FILTERS:
        raise UsageError(f"ps: --filter {text}: it must be KEY=VALUE, with {listed(_FILTERS)}")
    return key, value


def _rows(session: Session) -> Iterator[_RunningNode]:
    prefix = f"{session.namespace}/" if session.namespace else ""
    for node, state in session.states().items():
        yield _RunningNode(
            session.run,
            _user_name(session.user),
            session.project,
            prefix + node,
            _where(session, node),
            session.since,
            state,
            session.folder,
        )


def _where(session: Session, node: str) -> str:
    machine = session.elsewhere.get(node)
    return f"{session.backend} on {machine}" if machine else session.backend


def _table(rows: Sequence[_RunningNode], *, shows_users: bool) -> str:
    from tabulate import tabulate

    cells = []
    for row in rows:
        since = datetime.fromtimestamp(row.since).strftime("%Y-%m-%d %H:%M:%S")
        users = [row.user] if shows_users else []
        head = [row.run[:_SHOWN], *users, row.project]
        cells.append([*head, row.node, row.backend, since, row.state])
    users = ["user"] if shows_users else []
    header = ["run", *users, "project", "node", "back end", "since", "state"]
    return str(tabulate(cells, headers=header))


def _user_name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)


def _stop(options: argparse.Namespace) -> int:
    found = sessions()
    chosen = chosen_runs(options.runs, found, is_all=options.all)
    if not chosen:
        print("you have no run in progress" if found else "nothing is running")
    for session in chosen:
        session.interrupt()
    _await_end(chosen)
    for session in chosen:
        print(f"stopped {session.run[:_SHOWN]} ({session.project}); run folder {session.folder}")
    for name in remove_dead_runs():
        print(f"removed {name} from shared memory: its run was killed, and its reaper, too")
    return 0


def chosen_runs(
    names: Sequence[str], found: Sequence[Session], *, is_all: bool
) -> Sequence[Session]:
    """The runs that are named, among those that there are; without a name, the only one.

    Raises:
        UsageError: if there is none of a name, or several and no name.
    """
    own = [session for session in found if session.is_own]
    if is_all or (not names and len(own) <= 1):
        return own
    shown = ", ".join(f"{session.run[:_SHOWN]} ({session.project})" for session in own)
    if not names:
        raise UsageError(f"several runs are in progress: name one of {shown}, or give --all")
    for name in names:
        if not any(_is_named(session, name) for session in found):
            raise UsageError(f"you have no run called '{name}'; yours are: {shown or 'none'}")
    return [session for session in found if any(_is_named(session, name) for name in names)]


def _is_named(session: Session, name: str) -> bool:
    is_project = session.project == name and session.is_own
    return is_project or (bool(name) and session.run.startswith(name))


def _await_end(chosen: Sequence[Session]) -> None:
    """Until the reapers have gone, and with them all that they guard."""
    begin_s = time.monotonic()
    waiting, has_insisted = {session.run for session in chosen}, False
    while waiting := waiting & {session.run for session in sessions()}:
        waited_s = time.monotonic() - begin_s
        if waited_s > _AGAIN_S and not has_insisted:
            has_insisted = True
            for session in chosen:
                if session.run in waiting:
                    session.interrupt()  # the second one kills at once
        if waited_s > _GIVE_UP_S:
            left = ", ".join(sorted(run[:_SHOWN] for run in waiting))
            raise EnvironmentFault(f"not ended after {_GIVE_UP_S:g} s: {left}: see `neuros ps`")
        time.sleep(_POLL_S)


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
    worlds = {f"world_{node}.html": page.encode() for node, page in world_pages(run).items()}
    try:
        panels = panels_page(run)
    except EnvironmentFault as fault:
        panels = None
        print(f"missing: panels: {fault}")
    pages = {} if panels is None else {"panels.html": panels.encode()}
    _write(folder, {**files, _PAGE: text.encode(), **worlds, **pages})
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
        _write(options.output.parent, {options.output.name: _comparison(runs, header, rows)})
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


def _write(folder: Path, files: dict[str, bytes]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            (folder / name).write_bytes(data)
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
    verify.epilog = "exit codes: 0 identical, 1 different, 2 nothing to compare"
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
    result, exit_code = "identical", 0
    if verdict.difference is not None:
        result, exit_code = "different", EXIT_DIFFERENT
    elif not verdict.compared and verdict.remarks:
        result, exit_code = "unknown", EXIT_UNKNOWN
    if options.format == JSON:
        found = {"packets": verdict.compared, "difference": verdict.difference, "notes": remarks}
        print_json({"verdict": result, **found})
        return exit_code
    for remark in remarks:
        print(f"note: {remark}")
    packets = f"{verdict.compared} packet{'' if verdict.compared == 1 else 's'}"
    why = {"different": verdict.difference, "unknown": "there is nothing to compare"}
    print(f"{result}: {why.get(result, packets)}")
    return exit_code


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
    from neuros.recording.recorder import KEPT_NAME, repair

    def complain(text: str) -> None:
        print(f"neuros: {text}", file=sys.stderr)

    repaired = repair(Path(options.run), complain, keeps_changed=options.keep_changed)
    if repaired is None:
        print(f"{options.run}: the bag is complete")
        return 0
    counts = repaired.counts
    print(f"{options.run}: completed, {sum(counts.values())} packets on {len(counts)} topics")
    if not repaired.changed:
        return 0
    what = "kept" if options.keep_changed else f"left out: {KEPT_NAME} has them"
    complain(f"{repaired.changed} packets, any of which may have changed, are {what}")
    return EXIT_DAMAGED
