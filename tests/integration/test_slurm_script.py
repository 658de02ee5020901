"""A project in an allocation of a real Slurm of one node: its agent is a step of the job."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from slurm import slurm_cluster

from neuros.api.slurm_script import slurm_script
from neuros.project.deployment import load_deployment

STREAM = Path(__file__).parent / "network" / "stream"
NEUROS = Path(sys.executable).with_name("neuros")
_ENDED_S = 300.0


def test_each_cluster_node_gets_an_agent_by_its_number(tmp_path: Path) -> None:
    script = slurm_script("whiskeye", {"robot": 2, "eye": 2, "snn": 1}, options=["--record"])
    assert "#SBATCH --nodes=3\n" in script
    assert 'neuros launch whiskeye --record --deployment "$deployment" "$@" &' in script
    match = re.search(r"<<'END'\n(.*)\nEND\n", script, re.DOTALL)
    assert match is not None
    (tmp_path / "deployment.json").write_text(match[1])
    deployment = load_deployment(tmp_path / "deployment.json")
    assert deployment.places == {"robot": "node2", "eye": "node2", "snn": "node1"}
    assert "--relative=2" in deployment.hosts["node2"].through


@pytest.fixture
def slurm() -> Iterator[dict[str, str]]:
    with slurm_cluster() as environment:
        yield environment


@pytest.mark.acceptance
def test_a_submitted_script_runs_a_project_with_an_agent(
    slurm: dict[str, str], tmp_path: Path
) -> None:
    project = Path(shutil.copytree(STREAM, tmp_path / "stream"))
    run = tmp_path / "run"
    script = tmp_path / "stream.sh"
    script.write_text(
        slurm_script(project, {"sink": 0}, neuros=str(NEUROS), options=["-o", str(run)])
    )
    environment = {**os.environ, **slurm, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    subprocess.run(
        ["sbatch", "--wait", str(script)],
        cwd=tmp_path,
        env=environment,
        timeout=_ENDED_S,
        check=False,
    )
    logs = "".join(file.read_text() for file in tmp_path.glob("*.log"))
    assert (run / "run.json").exists(), logs
    record = json.loads((run / "run.json").read_text())
    assert record["exit_code"] == 0, logs
    assert record["machines"]["node0"]["nodes"] == ["sink"]
    assert json.loads((run / "sink/received.json").read_text())["numbers"] == list(range(1, 101))
