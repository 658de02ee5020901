"""``neuros reproduce``: the published experiments, with the examples of the source checkout."""

from __future__ import annotations

import argparse
import math

from neuros.cli.checkout import checkout_command, positive_number
from neuros.errors import UsageError

_EPILOG = """\
exit codes:
  0    done (whether the figures are like those that were published or not)
  1    a run failed; the others were made
  2    wrong usage
  4    something is missing: Matplotlib, or the source checkout
  130  ended by Ctrl+C: the runs that had ended are kept and shown
"""


def add_reproduce(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    reproduce = commands.add_parser(
        "reproduce",
        help="make the published experiments again",
        description="Make a published experiment again, one run after the other, and write its"
        " tables and figures, with the published numbers beside them.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = reproduce.add_argument
    add(
        "experiment",
        choices=("whiskeye", "tick", "voting", "elevator"),
        help="whiskeye: the robot in its seven orchestrations; tick: how regular ticks are, beside"
        " a timer of rclpy; voting: what is added to three tasks of 5 s at once; elevator: how fast"
        " a simulation is in three orchestrations",
    )
    add("--repeat", type=positive_number, metavar="N", help="runs of each part (default: 1)")
    add(
        "--only",
        nargs="+",
        metavar="NAME",
        help="only these parts: tick_20ms, tick_60ms, tick_100ms, the same with _1ms behind it,"
        " strict, no_discard_limit, asynchronous, hybrid (whiskeye); neuros, rclpy (tick); strict,"
        " no_discard_limit, asynchronous (elevator)",
    )
    add(
        "--duration",
        type=_seconds,
        metavar="SECONDS",
        help="of a run: simulated seconds of whiskeye, else wall seconds (default: 20 for whiskeye"
        " and elevator, 60 for tick and voting)",
    )
    add(
        "--backend",
        choices=("auto", "docker", "process", "in-process"),
        help="where nodes run, as for launch (default: NEUROS_BACKEND, else auto)",
    )
    add(
        "-o",
        "--output",
        metavar="DIR",
        help="a new folder, or one of an earlier call: runs are added to it"
        " (default: build/reproduce/<experiment>/<utc time>)",
    )
    add(
        "--from",
        dest="source",
        metavar="DIR",
        help="run nothing; make tables and figures in this folder again",
    )
    reproduce.set_defaults(command=_reproduce)


def _reproduce(options: argparse.Namespace) -> int:
    given = (options.repeat, options.only, options.duration, options.backend, options.output)
    if options.source is not None and any(each is not None for each in given):
        raise UsageError("--from runs nothing: no other option goes with it")
    return int(checkout_command("benchmarks.reproduce.command").run(options))


def _seconds(text: str) -> float:
    seconds = float(text)
    if not (seconds > 0 and math.isfinite(seconds)):
        raise ValueError(text)
    return seconds
