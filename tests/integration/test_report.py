"""Reports of real runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, launch

from neuros.cli.main import main

FIGURES = {"graph", "time_shares", "swim_lanes", "real_time", "packets", "latency"}


@pytest.mark.parametrize("back_end", BACKENDS)
def test_a_run_of_the_elevator_becomes_a_page(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    finished = launch(
        EXAMPLES / "3_physics_simulation/elevator",
        *("--backend", back_end, "--duration", "2sim", "-o", str(tmp_path / "run")),
        cwd=tmp_path,
    )
    assert finished.exit_code == 0, finished.output
    assert main(["report", str(tmp_path / "run")]) == 0
    assert {path.stem for path in (tmp_path / "run/report").glob("*.png")} == FIGURES
    out = capsys.readouterr().out
    (missing,) = (line for line in out.splitlines() if line.startswith("missing:"))
    assert "without -m" in missing
    page = (tmp_path / "run/report/report.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == len(FIGURES)
