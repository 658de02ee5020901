"""The choice of an executor, what a job asks for, and what a long sweep costs its front end."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest
from api_projects import dice
from neuros_analysis.sweep import open_executor
from neuros_cluster.dask import _resources_for
from neuros_cluster.slurm import _parameters

import neuros
from neuros.api.run import Run
from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import JobResources, SweepPlan

FACES = "nodes.thrower.environment.FACES"
GIBIBYTE = 1 << 30


def plan(folder: Path, count: int | None = None, **needs: Any) -> SweepPlan:
    return SweepPlan("dice", folder, count, JobResources(**needs), "neuros")


def needs_of(folder: Path, *nodes: dict[str, Any]) -> JobResources:
    file = dice(folder) / "project.json"
    project = json.loads(file.read_text())
    project["nodes"] = [{**a, **b} for a, b in zip(project["nodes"], nodes, strict=True)]
    file.write_text(json.dumps(project))
    return JobResources.of(neuros.Project.from_file(file).described())


def test_a_job_asks_for_the_resources_of_all_nodes_summed(tmp_path: Path) -> None:
    one = {"resources": {"cpus": 1.5, "memory": "512m"}, "gpus": ["0"]}
    other = {"resources": {"cpus": 1, "memory": "1g"}, "gpus": ["0", "1"]}
    assert needs_of(tmp_path, one, other) == JobResources(3, GIBIBYTE + GIBIBYTE // 2, 2)


def test_what_no_node_declares_is_not_asked_for(tmp_path: Path) -> None:
    assert needs_of(tmp_path, {}, {"gpus": "all"}) == JobResources(None, None, 1)


def test_the_jobs_of_an_array_ask_for_the_most_that_one_needs() -> None:
    assert JobResources.most(
        [JobResources(2, None, 0), JobResources(1, GIBIBYTE, 1)]
    ) == JobResources(2, GIBIBYTE, 1)


def test_slurm_is_asked_for_whole_cores_mebibytes_and_gpus(tmp_path: Path) -> None:
    asked = _parameters("fast", plan(tmp_path, cpus=3, mem_bytes=GIBIBYTE + 1, gpus=2))
    assert asked["partition"] == "fast"
    assert asked["cpus_per_task"] == 3
    assert asked["srun_args"] == ["--cpus-per-task", "3"]
    assert asked["additional_parameters"] == {"chdir": "/", "mem": "1025M", "gpus-per-node": 2}
    assert asked["time"] is None, "the cluster decides"


def test_dask_is_asked_for_what_its_workers_declare(tmp_path: Path) -> None:
    wanted = plan(tmp_path, cpus=3, gpus=1)
    assert _resources_for(wanted, []) == {}
    assert _resources_for(wanted, [{"GPU": 2}, {}]) == {"GPU": 1.0}
    with pytest.raises(EnvironmentFault, match="no worker has what a run of dice needs"):
        _resources_for(wanted, [{"CPU": 2}])


@pytest.mark.parametrize(
    ("wanted", "count", "reason"),
    [
        ("slum", None, r"executor 'slum': choose one of .*'slurm'"),
        ("local=here", None, "give local alone"),
        ("dask=", None, "give dask=ADDRESS"),
        ("dask=tcp://10.0.0.7:8786", 2, "the workers there decide how many"),
    ],
)
def test_what_makes_no_sense_is_refused(
    wanted: str, count: int | None, reason: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=reason), open_executor(wanted, plan(tmp_path, count)):
        pass


@pytest.mark.parametrize(
    ("name", "library", "package"),
    [("slurm", "submitit", "submitit"), ("dask", "distributed", r"Dask \(distributed\)")],
)
def test_a_library_that_is_missing_is_named_with_what_installs_it(
    name: str, library: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    said = rf"executor {name}: {package} is not installed.*pip install 'neuros\[{name}\]'"
    with pytest.raises(EnvironmentFault, match=said), open_executor(name, plan(tmp_path)):
        pass


@pytest.mark.parametrize("tool", ["sbatch"])
def test_a_machine_that_does_not_submit_to_slurm_says_so(
    tool: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    said = f"{tool}, squeue, scancel is not on PATH"
    with pytest.raises(EnvironmentFault, match=said), open_executor("slurm", plan(tmp_path)):
        pass


def test_the_executor_that_is_given_decides_how_many_runs_go_on(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the executor that is given decides"):
        neuros.sweep(dice(tmp_path), executor=Instant(tmp_path), jobs=2, output=tmp_path / "t")


class Instant(Executor):
    """Has the record of a run, and "makes" every run by writing it."""

    def __init__(self, record: Path) -> None:
        self._record = record

    def submit(self, job: Callable[..., Any], /, *_: Any, **__: Any) -> Future[Any]:
        from neuros_analysis.sweep import SweepJob, row_of

        assert isinstance(job, SweepJob)
        job.folder.mkdir()
        (job.folder / "run.json").symlink_to(self._record)
        future: Future[Any] = Future()
        future.set_result({**row_of(job.values, Run(self._record.parent)), "folder": "there"})
        return future


OPENED: Counter[str] = Counter()


def _count(event: str, arguments: tuple[Any, ...]) -> None:
    # What open() opens by a function of its own, that tells, too, without a mode.
    if event == "open" and isinstance(arguments[0], str | os.PathLike) and arguments[1]:
        OPENED[os.fspath(arguments[0])] += 1


@pytest.fixture(scope="module")
def opened() -> Counter[str]:
    """How often this process has opened which file."""
    sys.addaudithook(_count)
    return OPENED


@pytest.mark.ros
def test_a_front_end_reads_no_run_folder_twice_and_writes_the_table_now_and_then(
    tmp_path: Path, opened: Counter[str]
) -> None:
    project = neuros.Project.from_file(dice(tmp_path))
    record = project.run(backend="in-process", output=tmp_path / "one").folder / "run.json"
    table = tmp_path / "table"

    def swept() -> Any:
        executor = Instant(record)
        return neuros.sweep(project, set={FACES: range(1, 101)}, executor=executor, output=table)

    opened.clear()
    assert len(swept().rows) == 100
    records = [str(path) for path in table.glob("*/run.json")]
    assert len(records) == 100
    assert [path for path in records if opened[path]] == [], "a job sends the row of its run"
    assert opened[str(table / "sweep.csv.new")] < 20
    opened.clear()
    assert len(swept().rows) == 100
    assert {opened[path] for path in records} == {1}
