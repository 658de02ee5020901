"""What virtual time costs nodes in processes of their own: WhiskEye, strict, with both clocks.

The rest of a run, which initialises and ends, is measured by a run of 0.2 simulated seconds.
"""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

from benchmarks.launching import launch
from benchmarks.measure import Case, Figure, Group, Subject
from benchmarks.subjects.whiskeye import SIMULATED_S, WHISKEYE

CLOCKS = ("real", "virtual")
REST_S = 0.2


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run."""
    simulated_s = SIMULATED_S * (0.1 if is_quick else 3.0)  # long beside the rest of a run
    return Subject(
        "virtual time between processes against real time",
        (
            Group(
                {clock: functools.partial(simulation_s, clock, simulated_s) for clock in CLOCKS},
                (
                    Case(
                        f"whiskeye strict, process, {simulated_s:g} s simulated in virtual time",
                        "s",
                        Figure("virtual"),
                        Figure("real"),
                        "real time",
                        "virtual-time",
                    ),
                ),
            ),
        ),
    )


def simulation_s(clock: str, simulated_s: float) -> float:
    """Wall seconds that this many simulated seconds take."""
    return _wall_s(clock, simulated_s + REST_S) - _wall_s(clock, REST_S)


def _wall_s(clock: str, simulated_s: float) -> float:
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        run = launch(
            WHISKEYE / "strict.json",
            Path(folder) / "run",
            "process",
            settings={"nodes.robot.environment.DURATION": simulated_s},
            options=["--time", clock],
        )
    return float(run["wall_s"])
