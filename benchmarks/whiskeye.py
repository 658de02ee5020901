"""WhiskEye's real-time factor against the same experiment in one loop without NeuROS.

``floor.py`` of the example: same model, network and figure, redrawn as often. In one process
NeuROS can only lose against it; between processes the network and the robot overlap.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.launching import cores, launch
from benchmarks.measure import Measurement, Row, Target, in_rounds

WHISKEYE = Path(__file__).resolve().parents[1] / "examples" / "4_neurorobotics" / "whiskeye"
TARGETS = {"in process": 0.85, "network on a core of its own": 0.85, "left to the kernel": 0.65}


def measure(is_quick: bool, say: Callable[[str], None]) -> list[Row]:
    """All rows of this module."""
    duration_s, rounds = (5, 1) if is_quick else (20, 7)
    candidates: dict[str, Measurement] = {
        "floor": functools.partial(floor, duration_s),
        "in process": functools.partial(strict, duration_s, "in-process"),
        "left to the kernel": functools.partial(strict, duration_s, "process"),
    }
    if len(cores()) > 1:
        candidates["network on a core of its own"] = functools.partial(
            strict, duration_s, "process", own_core="snn"
        )
    values = in_rounds(candidates, rounds, say)
    return [
        Row(
            f"whiskeye real-time factor, {'' if name == 'in process' else 'process, '}{name}",
            "",
            values[name],
            ("one loop", values["floor"]),
            Target(TARGETS[name], is_maximum=False),
        )
        for name in values
        if name != "floor"
    ]


def floor(duration_s: float) -> float:
    """Real-time factor of the loop without NeuROS."""
    command = [sys.executable, "floor.py", "--duration", str(duration_s)]
    environment = {
        **os.environ,
        "NEUROS_GUI": "0",
        **{f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")},
    }
    output = subprocess.run(
        command, cwd=WHISKEYE, env=environment, check=True, text=True, stdout=subprocess.PIPE
    ).stdout
    return float(json.loads(output.splitlines()[-1])["real_time_factor"])


def strict(duration_s: float, backend: str, own_core: str | None = None) -> float:
    """Real-time factor of ``strict.json``, without initialisation and ending."""
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        run = launch(
            WHISKEYE / "strict.json",
            Path(name) / "run",
            backend,
            settings={"nodes.robot.environment.DURATION": duration_s},
            own_core=own_core,
        )
    return float(run["real_time_factor"])
