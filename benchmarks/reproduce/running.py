"""Runs one after the other, so that none disturbs another; what is done is on disk at once."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from functools import partial

from benchmarks.machine import load_before
from benchmarks.reproduce.experiment import Entry, Experiment
from benchmarks.reproduce.kinds import Kind

_LINES = 40


def run_all(
    experiment: Experiment,
    kind: Kind,
    names: Sequence[str],
    repeat: int,
    backend: str,
    say: Callable[[str], None],
) -> bool:
    """Run each part ``repeat`` times, every other time in the opposite order; what trains first.

    Returns:
        whether all of them went well. Ctrl+C leaves those that had ended.
    """
    is_good = True
    orders = [names[:: -1 if turn % 2 else 1] for turn in range(repeat)]
    order = [name for each in orders for name in sorted(each, key=lambda name: name != kind.trains)]
    total = len(order)
    for done, name in enumerate(order):
        entry = _run(experiment, kind, name, backend, partial(_say, say, f"{done + 1}/{total}"))
        is_good &= not entry.failure
    return is_good


def _run(
    experiment: Experiment, kind: Kind, name: str, backend: str, say: Callable[[str], None]
) -> Entry:
    load = load_before()
    offset_s = time.time() - time.monotonic()
    entry = Entry(name, experiment.next_number(name), load, offset_s)
    say(f"{entry.title} (others keep {load:.0%} of the cores busy)")
    folder = experiment.run_folder(entry)
    start_s = time.monotonic()
    failure = ""
    try:
        kind.run(name, folder, experiment.duration_s, backend)
        kind.read(folder, entry)  # one that left nothing to read has failed
    except Exception as error:  # one broken run must not cost the others
        failure = _describe(error)
        say(f"{entry.title} FAILED: {failure.splitlines()[-1]}")
    else:
        say(f"{entry.title}: done in {time.monotonic() - start_s:.0f} s")
    entry = Entry(name, entry.number, load, offset_s, failure)
    experiment.runs.append(entry)
    experiment.write()
    return entry


def _say(say: Callable[[str], None], where: str, text: str) -> None:
    say(f"{where} {text}")


def _describe(error: Exception) -> str:
    """The error, with the last lines of what was printed."""
    if isinstance(error, subprocess.TimeoutExpired):
        return f"not ended after {error.timeout:g} s"
    lines = f"{type(error).__name__}: {error}".strip().splitlines()
    return "\n".join([*lines[:1], *lines[1:][-_LINES:]])
