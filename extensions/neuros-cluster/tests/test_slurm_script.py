"""``neuros export slurm``: a project in an allocation of a real Slurm, with agents as its steps."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from neuros_cluster.deployment_file import DeploymentFile, load_deployment
from neuros_cluster.slurm import slurm_script
from slurm import slurm_cluster

from neuros.cli.main import main

STREAM = Path(__file__).parents[3] / "tests/integration/network/stream"
WHERE = """
import os
from neuros.hooks import neuros_initialise

@neuros_initialise()
def tell(node):
    node.set_result("cluster_node", os.environ["SLURMD_NODENAME"])
    node.set_result("allocation", os.environ["SLURM_NODELIST"])
"""
_ENDED_S = 300.0


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Numbered images from one node to another; both tell on which node of the cluster they are."""
    made = Path(shutil.copytree(STREAM, tmp_path / "stream"))
    for plugin in ("source.py", "sink.py"):
        file = made / plugin
        file.write_text(file.read_text() + WHERE.replace("import os\n", "", 1))
    file = made / "sink.py"
    file.write_text(file.read_text().replace("import json\n", "import json\nimport os\n", 1))
    return made


def exported(project: Path, *options: str) -> str:
    folder = project.parent / "out"
    assert main(["export", "slurm", str(project), "-o", str(folder), *options]) == 0
    return (folder / "job.sh").read_text()


def deployment_in(script: str, folder: Path) -> DeploymentFile:
    match = re.search(r"<<'END'\n(.*)\nEND\n", script, re.DOTALL)
    assert match is not None
    (folder / "deployment.json").write_text(match[1])
    return load_deployment(folder / "deployment.json")


def test_each_cluster_node_gets_an_agent_by_its_number_and_the_first_the_launcher(
    tmp_path: Path,
) -> None:
    places = {"robot": 2, "eye": 2, "snn": 1, "visualiser": 0}
    script = slurm_script("whiskeye", places, options=["--record"])
    assert "#SBATCH --nodes=3\n" in script
    assert 'neuros launch whiskeye --record --deployment "$deployment" "$@" &' in script
    deployment = deployment_in(script, tmp_path)
    assert deployment.places == {"robot": "node2", "eye": "node2", "snn": "node1"}
    assert "--relative=2" in deployment.hosts["node2"].through


def test_the_script_has_what_the_project_is_launched_with(project: Path, tmp_path: Path) -> None:
    changed = ("--set", "nodes.source.environment.COUNT=7", "--duration", "9", "-d", "0")
    script = exported(project, "--place", "sink=1", *changed)
    command = f"launch {project} -d 0 --duration 9 --set nodes.source.environment.COUNT=7 "
    assert command in script
    assert deployment_in(script, tmp_path).places == {"sink": "node1"}


def test_a_job_asks_for_what_the_nodes_on_one_node_of_the_cluster_declare(project: Path) -> None:
    file = project / "project.json"
    content = json.loads(file.read_text())
    for node, cpus, memory in zip(content["nodes"], (1.5, 3), ("512m", "1g"), strict=True):
        node["resources"] = {"cpus": cpus, "memory": memory}
    file.write_text(json.dumps(content))
    apart = exported(project, "--spread")
    assert "#SBATCH --cpus-per-task=3\n#SBATCH --mem=1024M\n" in apart
    shutil.rmtree(project.parent / "out")
    together = exported(project)
    assert "#SBATCH --nodes=1\n" in together
    assert "#SBATCH --cpus-per-task=5\n#SBATCH --mem=1536M\n" in together


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("slurm", "--place", "snik=1"), "--place snik=1: the project has no such node; did you"),
        (("slurm", "--place", "sink"), "'sink': give NODE=NUMBER, as in robot=1"),
        (("slurm", "--registry", "lab"), "--registry is not for slurm"),
        (("compose", "--spread"), "--spread is not for compose"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    project: Path, options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    form, *others = options
    assert _code(["export", form, str(project), "-o", str(project.parent / "out"), *others]) == 2
    assert message in capsys.readouterr().err
    assert not (project.parent / "out").exists()


def _code(arguments: list[str]) -> int:
    try:
        return main(arguments)
    except SystemExit as ended:  # argparse
        return int(str(ended.code))


def test_the_script_says_what_it_needs_where_nodes_are_too_few(project: Path) -> None:
    exported(project, "--spread")
    done = subprocess.run(
        ["sh", str(project.parent / "out/job.sh")],
        env={**os.environ, "SLURM_JOB_NUM_NODES": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (4, "")
    assert "needs a Slurm allocation of 2 node(s)" in done.stderr


@pytest.fixture
def slurm() -> Iterator[dict[str, str]]:
    """Two nodes, each a daemon of this machine."""
    with slurm_cluster(cpus=1, names=("left", "right")) as environment:
        yield environment


@pytest.mark.acceptance
def test_a_submitted_script_places_nodes_on_the_nodes_of_its_allocation(
    slurm: dict[str, str], project: Path, tmp_path: Path
) -> None:
    exported(project, "--place", "sink=1")
    run = tmp_path / "run"
    subprocess.run(
        ["sbatch", "--wait", "out/job.sh", "-o", str(run)],
        cwd=tmp_path,
        env={**os.environ, **slurm, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        timeout=_ENDED_S,
        check=False,
    )
    logs = "".join(file.read_text() for file in tmp_path.glob("*.log"))
    assert (run / "run.json").exists(), logs
    record = json.loads((run / "run.json").read_text())
    assert record["exit_code"] == 0, logs
    assert record["machines"]["node1"]["nodes"] == ["sink"]
    assert json.loads((run / "sink/received.json").read_text())["numbers"] == list(range(1, 101))
    assert _results(record, "cluster_node") == {"source": "left", "sink": "right"}
    assert {*_results(record, "allocation").values()} == {"left,right"}


def _results(record: dict[str, Any], name: str) -> dict[str, Any]:
    return {node: each["results"][name] for node, each in record["nodes"].items()}
