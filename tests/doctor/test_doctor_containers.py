"""What the doctor says of Docker where there is none; with an engine: tests/integration/docker."""

from __future__ import annotations

import gc
from pathlib import Path

import pytest

from neuros.doctor.containers import look_at_containers
from neuros.doctor.findings import State


# The Docker SDK leaves a socket that could not connect to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_without_an_engine_one_line_says_why_and_nothing_is_wrong(tmp_path: Path) -> None:
    environ = {"DOCKER_HOST": f"unix://{tmp_path}/none.sock"}
    (finding,) = look_at_containers(["neuros_python"], environ)
    assert finding.state is State.ABSENT
    assert finding.subject == "Docker"
    assert f"{tmp_path}/none.sock" in finding.text
    gc.collect()
