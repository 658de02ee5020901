"""Faults by command: ``python -m tests.faults --hours 1``, ``--table FILE``, ``--launches 500``.

Runs every cell, or those that are chosen, once, or over and over for some hours. The exit code is
1 if any of them was not as it must be.
"""

from __future__ import annotations

import argparse
import functools
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from . import interrupts, launches, plugins, processes, surroundings
from .cells import BACKENDS, all_cells
from .trials import Outcome, Place

WHAT = ("plugins", "processes", "surroundings", "interrupts")
_Run = Callable[[Path], Outcome]


def main() -> int:
    """Run the cells; returns the exit code."""
    options = _options()
    # In the background of a shell, or under nohup, all that is started would ignore them.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if options.launches:
        return _launch(options)
    until_s = time.monotonic() + options.hours * 3600
    outcomes: list[Outcome] = []
    while not outcomes or time.monotonic() < until_s:
        for outcome in _round(options):
            outcomes.append(outcome)
            print(outcome, flush=True)
            if options.table:  # now: who interrupts a long row has what there is
                text = options.table.read_text("utf-8") if options.table.exists() else ""
                options.table.write_text(with_tables(text, [outcome]), "utf-8")
    failed = [outcome for outcome in outcomes if not outcome.is_well]
    print(f"{len(outcomes)} runs, {len(failed)} not as they must be")
    return 1 if failed else 0


def _launch(options: argparse.Namespace) -> int:
    began_s, problems = time.monotonic(), 0

    def show(number: int) -> None:
        if number % 50 == 0:
            print(f"{number} launches, {time.monotonic() - began_s:.0f} s", flush=True)

    with tempfile.TemporaryDirectory(prefix="neuros-faults-") as folder:
        for problem in launches.launches(Path(folder), options.launches, show):
            problems += 1
            print(problem, flush=True)
    took_s = time.monotonic() - began_s
    print(f"{options.launches} launches in {took_s:.0f} s, {problems} not as they must be")
    return 1 if problems else 0


def _round(options: argparse.Namespace) -> Iterator[Outcome]:
    """Run each of the chosen cells once."""
    with ThreadPoolExecutor(options.jobs) as executor:
        yield from executor.map(
            lambda cell: _in_folder(cell[0], cell[1], options), _chosen(options)
        )
    if "interrupts" in options.what:
        for backend in options.backend:
            yield from interrupts.interrupts(backend, _interrupt_in(options), options.step)


def _chosen(options: argparse.Namespace) -> Iterator[tuple[Place, _Run]]:
    """All cells that are chosen, but for interrupts, whose number depends on the machine."""
    is_chosen = re.compile(options.only).search
    cells: list[tuple[Place, _Run]] = []
    if "plugins" in options.what:
        for cell in all_cells():
            of_plugin = functools.partial(plugins.run, cell, flood_bytes=options.flood_bytes)
            cells.append((plugins.place_of(cell), of_plugin))
    if "processes" in options.what:
        for fault in processes.process_faults():
            cells.append((fault.place, functools.partial(processes.run, fault)))
    if "surroundings" in options.what:
        for each in surroundings.surroundings():
            cells.append((each.place, functools.partial(surroundings.run, each)))
    for place, run in cells:
        is_of_backend = any(re.search(rf"(at|,) {each}\b", str(place)) for each in options.backend)
        if is_of_backend and is_chosen(str(place)):
            yield place, run


def _interrupt_in(options: argparse.Namespace) -> Callable[[interrupts.Interrupt], Outcome]:
    def run(interrupt: interrupts.Interrupt) -> Outcome:
        return _in_folder(interrupt.place, functools.partial(interrupts.run, interrupt), options)

    return run


def _in_folder(place: Place, run: _Run, options: argparse.Namespace) -> Outcome:
    folder = Path(tempfile.mkdtemp(prefix="neuros-faults-"))
    try:
        try:
            outcome = run(folder)
        except Exception as error:  # the others go on
            text = f"{type(error).__name__}: {error}"
            outcome = Outcome(place, -1, "", 0.0, "", text, {}, [text.partition("\n")[0]])
        if not outcome.is_well and options.keep:
            kept = options.keep / re.sub(r"\W+", "_", str(outcome.place))
            shutil.rmtree(kept, ignore_errors=True)
            sockets = shutil.ignore_patterns("*.sock")
            shutil.copytree(folder, kept, symlinks=True, ignore=sockets)
            (kept / "output.txt").write_text(outcome.output)
        return outcome
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# ------------------------------------------------------------------ tables


def with_tables(text: str, outcomes: Sequence[Outcome]) -> str:
    """A text with the tables of outcomes in the place of those that it has between its marks.

    A table that is only run in part keeps its other rows.
    """
    for name in dict.fromkeys(outcome.place.table for outcome in outcomes):
        of_table = [outcome for outcome in outcomes if outcome.place.table == name]
        begin, end = f"<!-- generated: {name} -->\n", "<!-- generated: end -->"
        before, mark, rest = text.partition(begin)
        old, _, after = rest.partition(end)
        made = table(name, of_table, "" if of_table[0].place.begins else old)
        text = f"{before}{begin}\n{made}\n{end}{after if mark else chr(10)}"
    return text


def table(name: str, outcomes: Sequence[Outcome], old: str = "") -> str:
    """Markdown: what happened by when or where; a cell has exit code and seconds."""
    lines = [line for line in old.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    columns = dict.fromkeys(cells[0][1:] if cells else ())
    rows = {row[0]: dict(zip(columns, row[1:], strict=False)) for row in cells[2:]}
    for outcome in outcomes:
        columns[outcome.place.column] = None
        rows.setdefault(f"`{outcome.place.row}`", {})[outcome.place.column] = outcome.shown
    head = [name.rpartition(", ")[2], *columns]
    body = [[row, *(shown.get(each, "") for each in columns)] for row, shown in rows.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body)) + "\n"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.faults", description=__doc__)
    parser.add_argument(
        "what", nargs="*", metavar="WHAT", help=f"{', '.join(WHAT)} (all of them)", default=WHAT
    )
    parser.add_argument("--backend", action="append", choices=BACKENDS, help="repeatable (all)")
    parser.add_argument("--only", default="", metavar="REGEX", help="cells whose name has that")
    parser.add_argument("--hours", type=float, default=0.0, help="repeat for so long (once)")
    parser.add_argument(
        "--step", type=float, default=interrupts.STEP_S, help="seconds between interrupts (0.1)"
    )
    parser.add_argument("--jobs", type=int, default=1, help="so many runs at a time (1)")
    parser.add_argument("--flood-bytes", type=int, default=1 << 30, metavar="N", help="(2**30)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the folders of failed runs")
    parser.add_argument("--launches", type=int, metavar="N", help="only launch N times in a row")
    parser.add_argument(
        "--table", type=Path, metavar="FILE", help="write the tables, in Markdown, between marks"
    )
    options = parser.parse_args()
    if unknown := {*options.what} - {*WHAT}:
        parser.error(f"there is no {' and no '.join(sorted(unknown))}: {', '.join(WHAT)}")
    options.backend = options.backend or list(BACKENDS)
    return options


if __name__ == "__main__":
    sys.exit(main())
