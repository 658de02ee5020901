"""Slurm: runs of a sweep as jobs, in an array submitted with submitit; a project as a batch script.

submitit writes a file with the result of each job. ``squeue`` tells whether a job has ended without
one; submitit's ``sacct`` would need an accounting database.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import shutil
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from neuros.errors import EnvironmentFault
from neuros.installation.machine import answer_of
from neuros.ports import Job, JobResources, Jobs, SweepExecutor, SweepPlan
from neuros_cluster.dask import not_installed

FOLDER = ".slurm"
"""Logs, jobs and results, in the folder of the sweep."""

_MOST_IN_ARRAY = 1000  # MaxArraySize is 1001 where a cluster does not set it
_POLL_S, _ASK_S = 2.0, 15.0
_MEBIBYTE = 1 << 20
_TIMEOUT_S = 60.0
_UNKNOWN = "unknown to squeue"
_OVER = {
    *("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL"),
    *("OUT_OF_MEMORY", "PREEMPTED", "TIMEOUT"),
}
# The steps share what the job has with the batch step, where the launcher is.
_STEP = ("srun", "--overlap", "--mem=0", "--nodes=1", "--ntasks=1", "--mpi=none")


class SlurmExecutor(SweepExecutor):
    """Runs as jobs of a Slurm cluster that this machine submits to.

    ``sbatch`` reads further settings from its environment: ``SBATCH_TIMELIMIT``,
    ``SBATCH_ACCOUNT``, ``SBATCH_QOS``.
    """

    name = "slurm"
    place = "PARTITION"

    @contextmanager
    def open(self, place: str | None, plan: SweepPlan) -> Iterator[Jobs]:
        try:
            import submitit
        except ImportError as error:
            raise not_installed("submitit", self.name) from error
        missing = [name for name in ("sbatch", "squeue", "scancel") if not shutil.which(name)]
        if missing:
            raise EnvironmentFault(
                f"executor slurm: {', '.join(missing)} is not on PATH: run it on a machine that"
                " submits to the cluster (on Debian: apt-get install slurm-client)"
            )
        executor = submitit.SlurmExecutor(plan.folder / FOLDER)
        # A name for the jobs of this sweep alone.
        digest = hashlib.sha256(str(plan.folder).encode()).hexdigest()[:8]
        name = f"neuros-{_plain(plan.name)}-{digest}"
        executor.update_parameters(job_name=name, **_parameters(place, plan))
        # Waiting jobs of an earlier call are submitted again. Its running jobs go on, and the jobs
        # of the same runs wait for them and return their results.
        _slurm("scancel", "--quiet", "--state=PENDING", f"--name={name}")
        jobs = _SlurmJobs(executor, name, plan.count)
        try:
            yield jobs
        finally:
            jobs.close()


def _plain(name: str) -> str:
    """The name of a project in a form that ``#SBATCH`` accepts."""
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)


def _parameters(partition: str | None, plan: SweepPlan) -> dict[str, Any]:
    """The parameters of ``sbatch``; ``None`` where the cluster decides."""
    needs = plan.resources
    cpus = ["--cpus-per-task", str(needs.cpus)] if needs.cpus else []
    return {
        "partition": partition,
        "time": None,  # submitit's default is 5 minutes
        "cpus_per_task": needs.cpus,
        "srun_args": cpus,  # since 22.05 srun does not inherit it from its job
        "additional_parameters": {
            "chdir": "/",  # Python would import from the folder that the job begins in
            **({"mem": f"{-(-needs.mem_bytes // _MEBIBYTE)}M"} if needs.mem_bytes else {}),
            **({"gpus-per-node": needs.gpus} if needs.gpus else {}),
        },
    }


class _SlurmJobs:
    """The jobs of one sweep, and a thread that watches them."""

    def __init__(self, executor: Any, name: str, count: int | None) -> None:
        self._executor = executor
        self._name = name
        self._count = count
        self._open: dict[str, tuple[Any, Future[Any]]] = {}
        self._missed: set[str] = set()
        self._wake = threading.Event()
        self._is_cancelled = self._is_closed = False
        self._watcher = threading.Thread(target=self._watch, name="neuros-slurm", daemon=True)

    def submit(self, jobs: Sequence[Job]) -> list[Future[Any]]:
        parts = [jobs[i : i + _MOST_IN_ARRAY] for i in range(0, len(jobs), _MOST_IN_ARRAY)]
        futures: list[Future[Any]] = []
        for part in parts:
            at_once = max(1, self._count // len(parts)) if self._count else len(part)
            self._executor.update_parameters(array_parallelism=at_once)
            try:
                submitted = self._executor.map_array(_run_in_job, part)
            except Exception as error:  # submitit has a class for each version
                cause = getattr(error, "stderr", None) or error
                self.cancel()
                raise EnvironmentFault(f"sbatch refuses the jobs of the sweep: {cause}") from error
            for job in submitted:
                future: Future[Any] = Future()
                self._open[job.job_id] = (job, future)
                futures.append(future)
        self._watcher.start()
        return futures

    def cancel(self) -> None:
        self._is_cancelled = True
        _slurm("scancel", "--quiet", f"--name={self._name}")
        self._wake.set()

    def close(self) -> None:
        self._is_closed = True
        self._wake.set()
        if self._watcher.ident is not None:
            self._watcher.join()

    def _watch(self) -> None:
        asked_s = time.monotonic()
        while self._open and not self._is_closed:
            self._wake.wait(_POLL_S)
            self._wake.clear()
            # Set the results of ended jobs; lists the folder once, whatever the number of jobs.
            names = {file.name for file in Path(self._executor.folder).iterdir()}
            for number, (job, future) in tuple(self._open.items()):
                if job.paths.result_pickle.name not in names:
                    continue
                del self._open[number]
                try:
                    future.set_result(job.result())
                except Exception as error:  # what the job raised, or the file is broken
                    future.set_exception(error)
            if self._is_cancelled or time.monotonic() - asked_s >= _ASK_S:
                self._fail_lost()
                asked_s = time.monotonic()

    def _fail_lost(self) -> None:
        """Fail jobs without a result that Slurm reports as ended, or not at all, twice in a row."""
        said = _slurm(
            *("squeue", "--array", "--noheader", "--states=all"),
            *(f"--name={self._name}", "--format=%i %T"),
        )
        if said is None:  # squeue does not answer
            return
        states = dict(line.split(maxsplit=1) for line in said.splitlines() if line.strip())
        lost = {n for n in self._open if states.get(n, _UNKNOWN) in {*_OVER, _UNKNOWN}}
        for number in lost & self._missed:
            job, future = self._open.pop(number)
            state = states.get(number, _UNKNOWN)
            future.set_exception(
                EnvironmentFault(
                    f"its Slurm job {number} ended without a result ({state}): {job.paths.stderr}"
                )
            )
        self._missed = lost


def _slurm(*command: str) -> str | None:
    """The output of a command of Slurm; ``None`` if it fails."""
    done = answer_of(command, timeout_s=_TIMEOUT_S)
    return None if done is None or done.returncode else done.stdout


def _run_in_job(job: Job) -> Any:
    """Execute a job on its machine; a signal of Slurm ends the run as Ctrl+C would.

    Slurm signals with ``scancel``, and some time before the time limit. This replaces submitit's
    handlers, which would ignore the signal or submit the job again.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    for number in (signal.SIGTERM, signal.SIGUSR2):
        signal.signal(number, interrupt)
    return job()


SLURM = SlurmExecutor()


def filled(template: str, **values: str) -> str:
    """The text of a file in ``templates``, with values for its ``@names@``."""
    text = Path(__file__).with_name("templates").joinpath(template).read_text("utf-8")
    return re.sub(r"@(\w+)@", lambda match: values[match[1]], text)


def slurm_script(
    project: str | os.PathLike[str],
    places: Mapping[str, int],
    *,
    neuros: str = "neuros",
    options: Sequence[str] = (),
    resources: JobResources | None = None,
) -> str:
    """A script for ``sbatch`` that runs a project on the nodes of its allocation.

    Args:
        project: the project's path on the first node of the allocation.
        places: by node of the project, the number of the cluster's node in the allocation, from 0;
            other nodes run beside the launcher, on number 0.
        neuros: the command ``neuros`` on all of them.
        options: further options of ``neuros launch``.
        resources: the least resources of each cluster node.
    """
    needs = resources or JobResources()
    lines = [
        *([f"--cpus-per-task={needs.cpus}"] if needs.cpus else []),
        *([f"--mem={-(-needs.mem_bytes // _MEBIBYTE)}M"] if needs.mem_bytes else []),
        *([f"--gpus-per-node={needs.gpus}"] if needs.gpus else []),
    ]
    elsewhere = {node: number for node, number in places.items() if number}
    numbers = sorted({*elsewhere.values()})
    hosts = {
        f"node{number}": {"through": [*_STEP, f"--relative={number}"], "neuros": neuros}
        for number in numbers
    }
    nodes = {node: f"node{number}" for node, number in elsewhere.items()}
    name = os.path.basename(os.path.abspath(project)).removesuffix(".json")
    return filled(
        "job.sh",
        name=_plain(name),
        count=str(max(numbers, default=0) + 1),
        resources="".join(f"#SBATCH {line}\n" for line in lines),
        deployment=json.dumps({"hosts": hosts, "nodes": nodes}, indent=2),
        command=shlex.join([neuros, "launch", os.fspath(project), *options]),
    )
