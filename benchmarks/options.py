"""Options of ``neuros benchmark`` and ``neuros reproduce``; their programs are imported late."""

from __future__ import annotations

import argparse
import math

from neuros.api.request import Request
from neuros.errors import UsageError
from neuros.options import add_options, options_of, positive_number

_BENCHMARK_EPILOG = """\
exit codes:
  0    measured (whether the targets are met or not)
  1    a measurement failed, or with --against, a row is slower
  2    wrong usage
  4    there are no benchmarks: neuros is not installed from a source checkout
  130  ended by Ctrl+C: what was measured is kept
"""
_REPRODUCE_EPILOG = """\
exit codes:
  0    done (whether the figures are like those that were published or not)
  1    a run failed; the others were made
  2    wrong usage
  4    something is missing: Matplotlib, or the source checkout
  130  ended by Ctrl+C: the runs that had ended are kept and shown
"""


def add_benchmark(benchmark: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    benchmark.description = "Measure what NeuROS costs, compared with the same program without it."
    benchmark.epilog = _BENCHMARK_EPILOG
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
    add(
        "--quick",
        action="store_true",
        help="few and short rounds, to try it out: do not quote the figures",
    )
    add("-o", "--output", metavar="FILE", help="default: build/benchmarks/<utc time>.json")
    add("--from", dest="file", metavar="FILE", help="measure nothing; show these results")
    add(
        "--against",
        metavar="COMMIT",
        help="measure this checkout and another commit in turn, and show their ratios; exit code 1"
        " if a row is slower here by 5 %% at least, whatever it is by chance; 'landed': the last"
        " commit of origin's main branch, or the one before",
    )
    add("--write-docs", action="store_true", help="put the tables into docs/numbers.md")
    benchmark.set_defaults(command=_benchmark)


def _benchmark(options: argparse.Namespace) -> int:
    if options.subjects and (options.file or options.list):
        raise UsageError("--from and --list measure nothing: name no SUBJECT")
    from benchmarks.command import run

    return run(options)


def add_reproduce(reproduce: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    reproduce.description = (
        "Repeat a published experiment, one run after the other, and write its tables and figures"
        " beside the published numbers."
    )
    reproduce.epilog = _REPRODUCE_EPILOG
    add = reproduce.add_argument
    add(
        "experiment",
        choices=("whiskeye", "orchestrations", "headdirection", "tick", "voting", "elevator"),
        help="whiskeye: the robot in its seven orchestrations; orchestrations: the same in virtual"
        " time, accuracy against loss, latency and speed; headdirection: its eyes correct its"
        " heading; tick: how regular ticks are, compared with a timer of rclpy; voting: what"
        " NeuROS adds to three parallel tasks of 5 s; elevator: how fast a simulation is in three"
        " orchestrations",
    )
    add("--repeat", type=positive_number, metavar="N", help="runs of each part (default: 1)")
    add(
        "--only",
        nargs="+",
        metavar="NAME",
        help="only these parts: tick_20ms, tick_60ms, tick_100ms, the same with _1ms behind it,"
        " strict, no_discard_limit, asynchronous, hybrid (whiskeye); these seven with .published,"
        " .here, .15ms, .30ms, .60ms or .120ms behind them (orchestrations); training, left, right,"
        " left_biased, right_biased, left_biased_down (headdirection); neuros, rclpy (tick);"
        " strict, no_discard_limit, asynchronous (elevator)",
    )
    add(
        "--duration",
        type=_seconds,
        metavar="SECONDS",
        help="length of a run: in simulated seconds for whiskeye, orchestrations and"
        " headdirection, else in wall seconds (default: 20 for whiskeye and elevator, 10 for"
        " orchestrations, 60 for the others)",
    )
    add(
        "--weights",
        metavar="FILE",
        help="headdirection: use the weights of an earlier training run, and do not train",
    )
    add_options(reproduce, [each for each in options_of(Request) if each.name == "backend"])
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
    names = ("repeat", "only", "duration", "weights", "backend", "output")
    given = [getattr(options, name) for name in names]
    if options.source is not None and any(each is not None for each in given):
        raise UsageError("--from runs nothing: leave out all other options")
    from benchmarks.reproduce.command import run

    return run(options)


def _seconds(text: str) -> float:
    seconds = float(text)
    if not (seconds > 0 and math.isfinite(seconds)):
        raise ValueError(text)
    return seconds
