"""``neuros sweep``: a project with every combination of values and seeds."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping
from typing import Any

from neuros.cli.checkout import positive_number
from neuros.errors import UsageError

EXIT_FAILED = 1

_EPILOG = """\
exit codes:
  0    all runs ended normally
  1    a run did not; the others were made
  2    wrong usage
  3    the project is invalid with some of the values: nothing was run
  130  ended by Ctrl+C: the runs that had ended are kept, and not run again
"""


def add_sweep(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    command = commands.add_parser(
        "sweep",
        help="run a project with many values and seeds; one table of what comes out",
        description="Run a project with every combination of values and seeds, and write one"
        " table (sweep.csv). What has finished before in the same folder is not run again.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = command.add_argument
    add("project", metavar="PROJECT", help="a file, or a folder with a project.json")
    add(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE,...",
        help="as for launch, with one value or several (repeatable)",
    )
    add(
        "--seeds",
        type=_seeds,
        default=[],
        metavar="SEED,...",
        help="for every variable with SEED in its name in the environment of a node",
    )
    add("--repeat", type=positive_number, default=1, metavar="N", help="runs of each combination")
    add("--jobs", type=positive_number, default=1, metavar="N", help="runs at once (default: 1)")
    add(
        "--backend",
        help="as for launch (default: NEUROS_BACKEND, else auto)",
    )
    add("--duration", metavar="SECONDS", help="of each run, as for launch: 30, or 30sim")
    add("-r", "--record", action="store_true", help="record every connection of each run")
    add(
        "-o",
        "--output",
        metavar="DIR",
        help="a new folder, or that of an earlier call, to go on with it"
        " (default: runs/<project>/sweep-<utc time>)",
    )
    command.set_defaults(command=_sweep)


def _sweep(options: argparse.Namespace) -> int:
    from neuros.api.grid import parse_values
    from neuros.api.sweep import CSV_NAME, sweep

    values: dict[str, list[Any]] = {}
    for text in options.set:
        path, given = parse_values(text)
        if path in values:
            raise UsageError(f"--set {path}: is given twice; put the values behind one another")
        values[path] = given
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = _warn
        made = sweep(
            options.project,
            set=values,
            seeds=options.seeds,
            repeat=options.repeat,
            jobs=options.jobs,
            backend=options.backend,
            duration=options.duration,
            record=options.record,
            output=options.output,
            on_row=_say,
        )
    print(f"\n{made}\n\n{made.folder / CSV_NAME}")
    return 0 if all(row["exit_code"] == 0 for row in made.rows) else EXIT_FAILED


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """What may be a mistake in the project, without the line of Python that found it."""
    print(f"warning: {message}", file=sys.stderr)


def _say(number: int, count: int, row: Mapping[str, Any]) -> None:
    """One line when a run has ended."""
    values = list(row)[: list(row).index("exit_code")]
    what = ", ".join(f"{name}={row[name]}" for name in values) or "run"
    print(f"[{number}/{count}] {what}: {row['reason']}", flush=True)


def _seeds(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}': give whole numbers, as in 1,2,3") from None
