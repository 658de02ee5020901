"""WhiskEye's table of runs, from the files that a run leaves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

COMPARE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye/compare.py"


def run_folder(folder: Path, name: str, consumed: int, rms_deg: float | None) -> Path:
    """What a run leaves: 100 packets sent on each connection, some of them consumed."""
    connections = (
        "robot.imu -> snn.imu",
        "robot.pose -> visualiser.truth",
        "snn.estimate -> visualiser.estimate",
    )
    run = {
        "file": f"/somewhere/{name}",
        "backend": "process",
        "real_time_factor": 7.123,
        "connections": [
            {"connection": each, "sent": 100, "consumed": consumed} for each in connections
        ],
    }
    error = {"samples": consumed, "rms_deg": rms_deg, "max_deg": rms_deg and 2 * rms_deg}
    (folder / "visualiser").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(run))
    (folder / "visualiser/head_direction.json").write_text(json.dumps(error))
    return folder


def test_runs_are_put_side_by_side_as_markdown(tmp_path):
    runs = [
        run_folder(tmp_path / "a", "project.json", 100, 1.904),
        run_folder(tmp_path / "b", "tick_20ms.json", 0, None),
    ]
    command = [sys.executable, str(COMPARE), *map(str, runs)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    assert printed.stdout.splitlines() == [
        "| project file | back end | physics | IMU | to the plot | estimates | RMS | max. |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
        "| `project.json` | process | 7.12 | 100.0% | 100.0% | 100 | 1.90 | 3.81 |",
        "| `tick_20ms.json` | process | 7.12 | 0.0% | 0.0% | 0 | - | - |",
    ]
