"""Every subject of ``neuros benchmark`` still measures what it says, in its shortest form."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import subjects
from benchmarks.results import Results
from containers import require_containers
from neuros.cli.main import main

pytestmark = pytest.mark.acceptance


@pytest.mark.parametrize("name", subjects.names())
def test_each_subject_can_be_measured(name: str, tmp_path: Path) -> None:
    if name == "containers":
        require_containers("neuros_python", "neuros_mujoco", "neuros_nest")
    file = tmp_path / "results.json"
    assert main(["benchmark", name, "--quick", "-o", str(file)]) == 0
    rows = Results.read(file).rows
    assert rows
    assert all(row.values for row in rows)
