"""The fault matrix by command: ``python -m tests.faults --hours 1``, ``--table FILE``.

Runs every cell, or those that are chosen, once, or over and over for some hours. The exit code is
1 if any of them was not as it must be.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.tables import write_table

from .cells import BACKENDS, FAULTS, PLACES, Cell, all_cells
from .running import Outcome, run


def main() -> int:
    """Run the cells; returns the exit code."""
    options = _options()
    cells = [
        cell
        for cell in all_cells()
        if cell.backend in (options.backend or BACKENDS)
        and cell.fault in (options.fault or FAULTS)
        and cell.place in (options.place or PLACES)
    ]
    until_s = time.monotonic() + options.hours * 3600
    outcomes: list[Outcome] = []
    for _ in itertools.count():
        with ThreadPoolExecutor(options.jobs) as executor:
            for outcome in executor.map(lambda cell: _run(cell, options), cells):
                outcomes.append(outcome)
                print(_line(outcome), flush=True)
        if time.monotonic() >= until_s:
            break
    failed = [outcome for outcome in outcomes if outcome.problems]
    print(f"{len(outcomes)} runs, {len(failed)} not as they must be")
    if options.table:
        write_table(options.table, table(outcomes))
    return 1 if failed else 0


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: faults by place, one table per back end; a cell has exit code and seconds."""
    by_cell = {str(outcome.cell): outcome for outcome in outcomes}
    parts = []
    for backend in BACKENDS:
        rows = []
        for fault in FAULTS:
            shown = [by_cell.get(str(Cell(fault, place, backend))) for place in PLACES]
            if any(shown):
                texts = ["" if each is None else _shown(each) for each in shown]
                rows.append(f"| `{fault}` | {' | '.join(texts)} |")
        if rows:
            head = f"| {backend} | {' | '.join(PLACES)} |\n|{' --- |' * (len(PLACES) + 1)}\n"
            parts.append(head + "\n".join(rows) + "\n")
    return "\n".join(parts)


def _shown(outcome: Outcome) -> str:
    text = f"{outcome.exit_code}, {max(0.0, outcome.took_s):.1f} s"
    return f"**{text}: {'; '.join(outcome.problems)}**" if outcome.problems else text


def _line(outcome: Outcome) -> str:
    problems = "; ".join(outcome.problems) or "ok"
    return (
        f"{outcome.cell!s:45} {outcome.exit_code:4} {outcome.took_s:5.1f} s {outcome.bag:9}"
        f" {problems}\n    {outcome.said}"
    )


def _run(cell: Cell, options: argparse.Namespace) -> Outcome:
    folder = Path(tempfile.mkdtemp(prefix="neuros-faults-"))
    try:
        outcome = run(cell, folder, flood_bytes=options.flood_bytes)
        if outcome.problems and options.keep:
            kept = options.keep / str(cell).replace(" ", "_").replace(",", "")
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept, symlinks=True)
            (kept / "output.txt").write_text(outcome.output)
        return outcome
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.faults", description=__doc__)
    for name, choices in (("backend", BACKENDS), ("fault", tuple(FAULTS)), ("place", PLACES)):
        parser.add_argument(f"--{name}", action="append", choices=choices, help="repeatable")
    parser.add_argument("--hours", type=float, default=0.0, help="repeat for so long (once)")
    parser.add_argument("--jobs", type=int, default=1, help="so many runs at a time (1)")
    parser.add_argument("--flood-bytes", type=int, default=1 << 30, metavar="N", help="(2**30)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the folders of failed runs")
    parser.add_argument(
        "--table",
        type=Path,
        metavar="FILE",
        help="write a table in Markdown, between its marks if it has them",
    )
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
