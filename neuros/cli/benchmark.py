"""``neuros benchmark``: measures what NeuROS costs, with the benchmarks of the source checkout."""

from __future__ import annotations

import argparse

from neuros.cli.checkout import checkout_command, positive_number
from neuros.errors import UsageError

_EPILOG = """\
exit codes:
  0    measured (whether the targets are met or not)
  1    a measurement failed
  2    wrong usage
  4    there are no benchmarks: neuros is not installed from a source checkout
  130  ended by Ctrl+C: what was measured is kept
"""


def add_benchmark(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    benchmark = commands.add_parser(
        "benchmark",
        help="measure what NeuROS costs, against the same thing without it",
        description="Measure what NeuROS costs, side by side with the same thing without it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = benchmark.add_argument
    add("subjects", nargs="*", metavar="SUBJECT", help="what to measure (default: everything)")
    add("--list", action="store_true", help="show the subjects, and measure nothing")
    add("-k", "--rows", metavar="TEXT", default="", help="only rows whose name contains TEXT")
    add(
        "--rounds",
        type=positive_number,
        metavar="N",
        help="rounds (default: 10 where a target is held)",
    )
    add("--quick", action="store_true", help="few and short rounds: no figures to quote")
    add("-o", "--output", metavar="FILE", help="default: build/benchmarks/<utc time>.json")
    add(
        "--from",
        dest="files",
        nargs="+",
        metavar="FILE",
        help="measure nothing, but show these results; of rows in several files, the last",
    )
    add("--compare", nargs=2, metavar=("A", "B"), help="show what differs between two results")
    add("--figures", metavar="DIR", help="draw figures of the results (SVG)")
    add("--write-docs", action="store_true", help="put tables and figures into docs/numbers.md")
    benchmark.set_defaults(command=_benchmark)


def _benchmark(options: argparse.Namespace) -> int:
    if options.subjects and (options.files or options.compare or options.list):
        raise UsageError("--from, --compare and --list measure nothing: name no SUBJECT")
    return int(checkout_command("benchmarks.command").run(options))
