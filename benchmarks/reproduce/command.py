"""What ``neuros reproduce`` does, after its options were read (:mod:`benchmarks.options`)."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from benchmarks.interruption import interrupted_by_termination
from benchmarks.machine import ROOT
from benchmarks.reproduce.experiment import Experiment
from benchmarks.reproduce.kinds import WEIGHTS, Kind
from benchmarks.reproduce.results import write_results
from benchmarks.reproduce.running import run_all
from benchmarks.results import utc_time
from neuros.errors import EnvironmentFault, UsageError

_KINDS = {
    name: f"benchmarks.reproduce.{name}"
    for name in ("elevator", "headdirection", "orchestrations", "tick", "voting", "whiskeye")
}


def run(options: argparse.Namespace) -> int:
    """Run the command; returns its exit code.

    Raises:
        UsageError: for a name or a folder that does not fit.
        EnvironmentFault: where Matplotlib is missing.
    """
    kind = _kind(options.experiment)
    if options.source is not None:
        experiment = Experiment.open(Path(options.source), options.experiment)
        _finish(experiment, kind)
        return 0
    if options.weights:
        _check_weights(Path(options.weights), options.experiment, kind)
    names, duration_s = _chosen(kind, options.only), options.duration or kind.duration_s
    if options.weights and not options.only:
        names.remove(kind.trains)
    if duration_s < kind.shortest_s:
        raise UsageError(f"--duration {duration_s:g}: a run lasts at least {kind.shortest_s:g} s")
    folder = Path(options.output) if options.output else _new_folder(options.experiment)
    backend = options.backend or os.environ.get("NEUROS_BACKEND") or "auto"
    experiment = Experiment.begin(folder.absolute(), options.experiment, duration_s)
    if options.weights:
        _take_weights(Path(options.weights), experiment.folder / WEIGHTS)
    try:
        with interrupted_by_termination():
            is_good = run_all(experiment, kind, names, options.repeat or 1, backend, _say)
    except KeyboardInterrupt:
        _say("interrupted: the runs that had ended are kept")
        _finish(experiment, kind)
        return 130
    _finish(experiment, kind)
    return 0 if is_good else 1


def _kind(name: str) -> Kind:
    if find_spec("matplotlib") is None:
        raise EnvironmentFault("neuros reproduce needs Matplotlib: ./install.py")
    kind: Kind = importlib.import_module(_KINDS[name]).KIND
    return kind


def _chosen(kind: Kind, only: Sequence[str] | None) -> list[str]:
    if only is None:
        return list(kind.parts)
    if unknown := [name for name in only if name not in kind.parts]:
        raise UsageError(
            f"--only {' '.join(unknown)}: there is no such part (there are {', '.join(kind.parts)})"
        )
    return [name for name in kind.parts if name in only]


def _check_weights(file: Path, experiment: str, kind: Kind) -> None:
    if not kind.trains:
        raise UsageError(f"--weights: {experiment} takes none")
    if not file.is_file():
        raise UsageError(f"--weights {file}: there is no such file")


def _take_weights(file: Path, target: Path) -> None:
    """Copy weights into the folder of the experiment; not over others that runs were made with."""
    weights = file.read_bytes()
    if target.exists() and target.read_bytes() != weights:
        raise UsageError(f"{target.parent} has other weights: name another folder with -o")
    target.write_bytes(weights)


def _new_folder(experiment: str) -> Path:
    return ROOT / "build" / "reproduce" / experiment / utc_time()


def _finish(experiment: Experiment, kind: Kind) -> None:
    page = write_results(experiment, kind)
    for entry in experiment.runs:
        if entry.failure:
            _say(f"FAILED: {entry.title}: {entry.failure.splitlines()[-1]}")
    print(page)


def _say(line: str) -> None:
    """Show progress."""
    print(line, file=sys.stderr, flush=True)
