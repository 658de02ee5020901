"""Random projects by the thousand: ``python -m tests.conformance --runs 1000 --backend process``.

What breaks a rule is made smaller and kept as a file, which the tests then run first. The exit
code is 1 if there was any.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from neuros.errors import NeurosError

from .description import Project
from .judge import Violation
from .projects import drawn
from .running import LOCAL, WITHOUT_ROS, LoadMeter
from .search import KEPT, Case, Verdict, keep, shrunk, verdict_of, verdicts
from .virtual import differences

BACKENDS = ("in-process", "process", "docker", LOCAL, WITHOUT_ROS)


def main() -> int:
    """Draw, run, judge; returns the exit code."""
    options = _options()
    projects = drawn(options.runs, options.seed)
    if options.time == "virtual":
        return _compare(projects)
    cases = [
        Case(f"{options.seed}-{number}", backend, project)
        for number, project in enumerate(projects)
        for backend in options.backend or BACKENDS[:2]
        if options.only is None or number == options.only
    ]
    began_s, failed, once = time.monotonic(), [], 0
    for count, verdict in enumerate(verdicts(cases, options.jobs), 1):
        once += bool(verdict.unconfirmed)
        if verdict.violations:
            failed.append(verdict)
            print(verdict, flush=True)
        elif verdict.unconfirmed:
            print(f"{verdict.case.name}: once, and not again: {verdict.unconfirmed[0]}", flush=True)
        if count % 100 == 0:
            print(f"{count} runs in {time.monotonic() - began_s:.0f} s", flush=True)
    for verdict in failed:
        _keep_smallest(verdict, options.folder, options.shrink)
    print(f"{len(cases)} runs (seed {options.seed}) in {time.monotonic() - began_s:.0f} s:"
          f" {len(failed)} broke a rule, {once} did so once and not again")  # fmt: skip
    return 1 if failed else 0


def _compare(projects: Sequence[Project]) -> int:
    """Compare runs in virtual time with the naive model; returns the exit code."""
    began_s, wrong = time.monotonic(), 0
    for number, project in enumerate(projects):
        if found := [*differences(project, number)]:
            wrong += 1
            print(f"{number}:", *found, sep="\n  ", flush=True)
        if (number + 1) % 100 == 0:
            print(f"{number + 1} runs in {time.monotonic() - began_s:.0f} s", flush=True)
    print(f"{len(projects)} runs in virtual time: {wrong} differ from the model")
    return 1 if wrong else 0


def _keep_smallest(verdict: Verdict, folder: Path, runs: int) -> None:
    with LoadMeter() as meter:
        judged = partial(_violations, verdict.case.backend, meter)
        smallest = shrunk(verdict, judged, runs)
    print(f"kept as {keep(smallest, folder)}: {len(smallest.case.project.nodes)} nodes,"
          f" {smallest.violations[0]}", flush=True)  # fmt: skip


def _violations(backend: str, meter: LoadMeter, project: Project) -> Sequence[Violation]:
    return verdict_of(Case("smaller", backend, project), meter).violations


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.conformance", description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="so many projects (100)")
    parser.add_argument(
        "--backend",
        action="append",
        choices=BACKENDS,
        help="may be given several times; else in-process and process",
    )
    parser.add_argument("--seed", type=int, default=1, help="the same seed, the same projects (1)")
    parser.add_argument(
        "--time",
        choices=("real", "virtual"),
        default="real",
        help="virtual: in sessions of this program, compared with a naive model (real)",
    )
    parser.add_argument("--only", type=int, help="only the project of this number")
    parser.add_argument("--jobs", type=int, default=2, help="so many runs at a time (2)")
    parser.add_argument(
        "--shrink",
        type=int,
        default=60,
        metavar="RUNS",
        help="for making one smaller, at most so many runs (60; 0: not at all)",
    )
    parser.add_argument("--folder", type=Path, default=KEPT, help="where what fails is kept")
    return parser.parse_args()  # fmt: skip


if __name__ == "__main__":
    try:
        sys.exit(main())
    except NeurosError as error:
        sys.exit(str(error))
