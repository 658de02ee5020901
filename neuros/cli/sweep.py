"""``neuros sweep``: a project with every combination of values and seeds."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping
from typing import Any

from neuros.api.request import SweepOptions
from neuros.options import add_options, options_of, values_of

EXIT_FAILED = 1

_EPILOG = """\
exit codes:
  0    all runs ended normally
  1    a run did not; the others were made
  2    wrong usage
  3    the project is invalid with some of the values: nothing was run
  130  ended by Ctrl+C: the runs that had ended are kept, and not run again
"""


def add_sweep(command: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    command.description = (
        "Run a project with every combination of values and seeds, and write one"
        " table (sweep.csv). What has finished before in the same folder is not run again."
    )
    command.epilog = _EPILOG
    command.add_argument(
        "project", metavar="PROJECT", help="a file, or a folder with a project.json"
    )
    add_options(command, options_of(SweepOptions))
    command.set_defaults(command=_sweep)


def _sweep(parsed: argparse.Namespace) -> int:
    from neuros.api.sweep import CSV_NAME, sweep

    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = _warn
        options = values_of(options_of(SweepOptions), parsed)
        made = sweep(parsed.project, **options, on_row=_say)
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
