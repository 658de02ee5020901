"""Sweeps on a real Dask cluster and on a real Slurm cluster of one node."""

from __future__ import annotations

import contextlib
import csv
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
import pytest
from api_projects import COUNTER, ENDLESS, dice
from slurm import slurm_cluster

import neuros
from neuros.errors import EnvironmentFault

FACES = "nodes.thrower.environment.FACES"
PROGRAM = """
import signal, sys
from neuros.cli.main import main
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main(sys.argv[1:]))
"""
# Python's own warning on processes that are forked beside threads is none of ours.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")


@pytest.fixture(scope="module")
def slurm() -> Iterator[dict[str, str]]:
    with slurm_cluster() as environment:
        yield environment


@pytest.fixture
def on_slurm(slurm: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in slurm.items():
        monkeypatch.setenv(name, value)


@pytest.fixture(scope="module")
def dask() -> Iterator[str]:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=2, dashboard_address=None, resources={"CPU": 2}
    ) as cluster:
        yield cluster.scheduler_address


def squeue(form: str) -> list[str]:
    done = subprocess.run(
        ["squeue", "--noheader", "--array", "--states=all", f"--format={form}"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split("\n")[:-1]


def with_resources(project: Path) -> Path:
    file = project / "project.json"
    limits = '"name": "thrower", "resources": {"cpus": 2, "memory": "600m"}'
    file.write_text(file.read_text().replace('"name": "thrower"', limits, 1))
    return project


def sums(sweep: Any) -> list[tuple[Any, Any]]:
    return [(row["FACES"], row["exit_code"]) for row in sweep.rows]


@pytest.mark.usefixtures("on_slurm")
def test_on_slurm_a_sweep_is_one_array_with_the_resources_of_the_project(tmp_path: Path) -> None:
    project = with_resources(dice(tmp_path, COUNTER.replace("== 13", "> 6")))
    told: list[tuple[int, int, int]] = []

    def tell(number: int, count: int, _: Any) -> None:
        with open(tmp_path / "table/sweep.csv", newline="") as file:
            told.append((number, count, len([*csv.DictReader(file)])))

    made = neuros.sweep(
        project,
        set={FACES: [1, 999999999]},
        backend="in-process",
        executor="slurm=first",
        output=tmp_path / "table",
        on_row=tell,
    )
    assert sums(made) == [(1, 0), (999999999, 1)]
    assert told[0] == (1, 2, 1), "the table fills while others go on"
    # %C cores, %m memory, %P partition
    jobs = [row.split() for row in squeue("%F %K %C %m %P %j")]
    ours = [row for row in jobs if row[-1].startswith("neuros-dice-")]
    assert len({row[0] for row in ours}) == 1, "it is one array"
    assert sorted(row[1] for row in ours) == ["0", "1"]
    assert {tuple(row[2:5]) for row in ours} == {("2", "600M", "first")}


@pytest.mark.usefixtures("on_slurm")
def test_a_job_that_is_killed_is_a_row_and_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros_cluster.slurm._ASK_S", 1.0)
    project = dice(tmp_path, ENDLESS)
    table = tmp_path / "table"
    arguments: dict[str, Any] = {"backend": "in-process", "executor": "slurm", "output": table}
    killer = threading.Thread(target=_kill_when_running, args=[table], daemon=True)
    killer.start()
    lost = neuros.sweep(project, **arguments).rows[0]
    killer.join()
    assert lost["exit_code"] is None
    assert "ended without a result (FAILED)" in lost["reason"]
    (project / "counter.py").write_text(COUNTER)
    assert neuros.sweep(project, **arguments).rows[0]["exit_code"] == 0


def _kill_when_running(table: Path) -> None:
    """Kill the process of the job, as a machine does that has no memory left."""
    while not [*table.glob("*/project.json")]:
        os.sched_yield()
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            line = process.cmdline()
            if "submitit.core._submit" in line and str(table) in line[-1]:
                process.kill()


@pytest.mark.usefixtures("on_slurm")
def test_a_job_outlives_its_front_end_and_its_row_is_taken_by_the_next(tmp_path: Path) -> None:
    go = tmp_path / "go"
    waits = f"__import__('os').path.exists({str(go)!r})"
    project = dice(tmp_path, COUNTER.replace("if len(seen) == 10", f"if {waits}"))
    table = tmp_path / "table"
    first = front_end(tmp_path, str(project), "-o", str(table))
    while not [*table.glob("*/project.json")]:
        assert first.poll() is None
    first.kill()
    first.wait()
    begun = Path(next(table.glob("*/project.json"))).stat().st_ino
    second = front_end(tmp_path, str(project), "-o", str(table))
    while len([row for row in squeue("%T %j") if row.startswith("RUNNING neuros-dice")]) < 2:
        assert second.poll() is None
    go.touch()
    assert second.wait(120) == 0
    (made,) = table.glob("*/run.json")
    assert (made.parent / "project.json").stat().st_ino == begun, "it was made once"


def front_end(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """`neuros sweep` on Slurm."""
    program = folder / "program.py"
    program.write_text(PROGRAM)
    options = ["--backend", "in-process", "--executor", "slurm"]
    return subprocess.Popen([sys.executable, str(program), "sweep", *arguments, *options])


@pytest.mark.usefixtures("on_slurm")
def test_ctrl_c_ends_the_jobs_and_the_sweep_goes_on_here(tmp_path: Path) -> None:
    project = dice(tmp_path, ENDLESS)
    table = tmp_path / "table"
    process = front_end(tmp_path, str(project), "-o", str(table), "--seeds", "1,2,3")
    while not [*table.glob("*/project.json")]:
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130
    assert {row for row in squeue("%T %j") if "PENDING" in row or "RUNNING" in row} == set()
    (project / "counter.py").write_text(COUNTER)
    made = neuros.sweep(project, seeds=[1, 2, 3], backend="in-process", output=table)
    assert [row["exit_code"] for row in made.rows] == [0, 0, 0]


def test_on_dask_workers_take_what_their_resources_allow(dask: str, tmp_path: Path) -> None:
    made = neuros.sweep(
        with_resources(dice(tmp_path)),
        set={FACES: [1, 2]},
        backend="in-process",
        executor=f"dask={dask}",
        output=tmp_path / "table",
    )
    assert sums(made) == [(1, 0), (2, 0)]
    files = [*(tmp_path / "table").glob("*/run.json")]
    assert len(files) == 2


def test_a_dask_scheduler_that_is_not_there_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros_cluster.dask._ANSWER_S", 0.5)
    with pytest.raises(EnvironmentFault, match="no Dask scheduler answers at tcp:"):
        neuros.sweep(dice(tmp_path), executor="dask=tcp://127.0.0.1:9", output=tmp_path / "table")


def test_any_executor_of_concurrent_futures_will_do_and_a_failed_run_is_retried(
    tmp_path: Path,
) -> None:
    project = dice(tmp_path, COUNTER.replace("== 13", "> 0"))
    arguments: dict[str, Any] = {"backend": "in-process", "output": tmp_path / "table"}
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        made = neuros.sweep(project, executor=pool, **arguments)
    assert made.rows[0]["exit_code"] == 1
    (project / "counter.py").write_text(COUNTER)
    assert neuros.sweep(project, **arguments).rows[0]["exit_code"] == 1, "a failed run is a row"
    assert neuros.sweep(project, **arguments, retry=True).rows[0]["exit_code"] == 0
    assert len([*(tmp_path / "table").glob("*.failed-1")]) == 1
