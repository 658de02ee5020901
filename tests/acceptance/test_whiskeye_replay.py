"""Every node of WhiskEye, recorded and replayed: NEST, MuJoCo and the plot."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from launching import EXAMPLES, Finished, launch

pytestmark = pytest.mark.acceptance

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"


@pytest.fixture(scope="module", params=["project.json", "strict.json"])
def orchestration(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module", params=["process", "in-process"])
def recorded(
    request: pytest.FixtureRequest, orchestration: str, tmp_path_factory: pytest.TempPathFactory
) -> Finished:
    folder: Path = tmp_path_factory.mktemp("run")
    back_end = ("--backend", str(request.param))
    run = launch(WHISKEYE / orchestration, *back_end, "-r", cwd=folder, timeout_s=240.0)
    assert run.exit_code == 0, run.output
    return run


@pytest.mark.parametrize("name", ["robot", "snn", "visualiser"])
def test_a_node_does_and_sends_the_same_again(recorded: Finished, name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "neuros.cli", "replay", str(recorded.run_folder), "--node", name],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    sent = [c for c in recorded.record["connections"] if c["connection"].startswith(f"{name}.")]
    packets = sum(c["sent"] for c in sent)
    assert f"identical: {packets} packets" in done.stdout or not sent
    assert "identical: " in done.stdout
