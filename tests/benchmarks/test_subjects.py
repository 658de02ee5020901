"""Every subject of ``neuros benchmark`` still measures what it says, in its shortest form."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import subjects
from benchmarks.results import Results
from containers import require_containers

pytestmark = pytest.mark.acceptance

REPOSITORY = Path(__file__).resolve().parents[2]
TIMEOUT_S = 900.0


@pytest.mark.parametrize("name", subjects.names())
def test_each_subject_can_be_measured(name: str, tmp_path: Path) -> None:
    if name == "containers":
        require_containers("neuros_python", "neuros_mujoco", "neuros_nest")
    file = tmp_path / "results.json"
    command = [sys.executable, "-m", "benchmarks", name, "--quick", "-o", file]
    done = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    results = Results.read(file)
    assert not any(notice.is_failure for notice in results.notices)
    groups = subjects.load([name], is_quick=True)[name].groups
    left_out = {notice.row for notice in results.notices}
    assert {row.name for row in results.rows} == {
        case.name for group in groups for case in group.cases
    } - left_out
    for row in results.rows:
        assert all(map(math.isfinite, (*row.values, *row.references))), row.name
