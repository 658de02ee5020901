"""Executors of sweeps: their interface, the choice of ``--executor``, and those that are pools.

Pools are threads of this process, and the workers of Dask.
"""

from __future__ import annotations

import math
import os
import signal
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import Project
from neuros.registry import Registry

_ANSWER_S = 20.0  # of a Dask scheduler

Job: TypeAlias = Callable[[], Any]
"""One run: a picklable callable, the result of which is picklable, too."""


@dataclass(frozen=True)
class JobResources:
    """What a job asks a cluster for; ``None`` and 0: nothing, so the cluster's default holds."""

    cpus: int | None = None
    mem_bytes: int | None = None
    gpus: int = 0

    @classmethod
    def of(cls, project: Project) -> JobResources:
        """The ``resources`` of all nodes summed.

        What a node does not declare counts nothing. A GPU that several nodes name counts once;
        ``all`` stands for those that the job gets, and asks for one.
        """
        cpus = [node.resources.cpus for node in project.nodes if node.resources.cpus]
        memory = [node.resources.mem_bytes for node in project.nodes if node.resources.mem_bytes]
        gpus = {gpu for node in project.nodes for gpu in node.access.gpus}
        return cls(
            math.ceil(sum(cpus)) if cpus else None,
            sum(memory) if memory else None,
            max(len(gpus - {"all"}), int("all" in gpus)),
        )

    @classmethod
    def most(cls, needs: Iterable[JobResources]) -> JobResources:
        """What is enough for each of several jobs."""
        listed = list(needs)
        return cls(
            max((each.cpus for each in listed if each.cpus), default=None),
            max((each.mem_bytes for each in listed if each.mem_bytes), default=None),
            max((each.gpus for each in listed), default=0),
        )


@dataclass(frozen=True)
class SweepPlan:
    """A sweep whose runs are to be executed.

    Attributes:
        name: of the project.
        folder: of the sweep, which every machine that executes runs sees under this path.
        count: how many runs at once, ``None``: as many as there is room for.
        resources: of each run.
    """

    name: str
    folder: Path
    count: int | None
    resources: JobResources


class Jobs(Protocol):
    """The jobs of one sweep."""

    def submit(self, jobs: Sequence[Job]) -> Sequence[Future[Any]]:
        """Hand over jobs, in this order; the futures have what they return.

        Raises ``EnvironmentFault``.
        """

    def cancel(self) -> None:
        """End the jobs. Those that begin later return at once by themselves."""


class SweepExecutor(ABC):
    """What executes runs of sweeps. An entry point of the group ``neuros.executors``.

    Attributes:
        name: in ``--executor``; that of the entry point.
        place: what ``--executor NAME=...`` names, as ``ADDRESS``; empty: nothing.
    """

    name: str
    place: str = ""

    @abstractmethod
    def open(self, place: str | None, plan: SweepPlan) -> AbstractContextManager[Jobs]:
        """Connect to what executes; the end of the context waits for the jobs that go on.

        Raises:
            UsageError: for a place or a count that makes no sense.
            EnvironmentFault: if something is missing, or does not answer.
        """


EXECUTORS: Registry[SweepExecutor] = Registry("neuros.executors", "executor", SweepExecutor)


class PoolJobs:
    """The jobs of a pool of :mod:`concurrent.futures`."""

    def __init__(self, pool: Executor) -> None:
        self._pool = pool

    def submit(self, jobs: Sequence[Job]) -> list[Future[Any]]:
        return [self._pool.submit(job) for job in jobs]

    def cancel(self) -> None:
        """Nothing: a job that begins now returns at once."""


def open_executor(wanted: str | Executor, plan: SweepPlan) -> AbstractContextManager[Jobs]:
    """The executor that is asked for: ``NAME``, ``NAME=PLACE``, or a pool of the caller's own.

    Raises ``UsageError`` and ``EnvironmentFault``.
    """
    if isinstance(wanted, Executor):
        if plan.count is not None:
            raise UsageError("jobs: the executor that is given decides how many runs go on at once")
        return nullcontext(PoolJobs(wanted))
    name, equals, place = wanted.partition("=")
    executor = EXECUTORS.load(name)
    if equals and not (place and executor.place):
        what = f"give {name}={executor.place}" if executor.place else f"give {name} alone"
        raise UsageError(f"--executor {wanted}: {what}")
    return executor.open(place or None, plan)


def not_installed(package: str, extra: str) -> EnvironmentFault:
    """The fault that an executor's library is missing."""
    return EnvironmentFault(
        f"executor {extra}: {package} is not installed for {sys.executable}:"
        f" pip install 'neuros[{extra}]'"
    )


class LocalExecutor(SweepExecutor):
    """Runs on this machine, one after the other, or ``--jobs`` at once."""

    name = "local"

    @contextmanager
    def open(self, place: str | None, plan: SweepPlan) -> Iterator[Jobs]:
        # A run is processes of its own: its launcher has enough with a thread.
        with ThreadPoolExecutor(plan.count or 1, thread_name_prefix="neuros-sweep") as pool:
            yield PoolJobs(pool)


class DaskExecutor(SweepExecutor):
    """Runs on the workers of a Dask scheduler; without an address, on workers of this machine."""

    name = "dask"
    place = "ADDRESS"

    @contextmanager
    def open(self, place: str | None, plan: SweepPlan) -> Iterator[Jobs]:
        try:
            from distributed import Client
        except ImportError as error:
            raise not_installed("Dask (distributed)", self.name) from error
        if place and plan.count is not None:
            raise UsageError(
                f"--jobs with --executor dask={place}: the workers there decide how many runs go"
                " on at once (dask worker --nthreads N)"
            )
        with ExitStack() as stack:
            where = place or stack.enter_context(_local_cluster(plan.count))
            is_file = place is not None and Path(place).is_file()
            given = {"scheduler_file": place} if is_file else {"address": where}
            try:
                client = stack.enter_context(
                    Client(**given, timeout=_ANSWER_S, set_as_default=False)
                )
            except (OSError, ValueError) as error:  # distributed's TimeoutError is an OSError
                raise EnvironmentFault(
                    f"no Dask scheduler answers at {place} ({error}): give the address that it"
                    " printed, as tcp://10.0.0.7:8786, or its scheduler file"
                ) from error
            _check_versions(client)
            workers = client.scheduler_info(n_workers=-1)["workers"].values()
            resources = _resources_for(plan, [worker["resources"] for worker in workers])
            yield PoolJobs(client.get_executor(pure=False, resources=resources))


@contextmanager
def _local_cluster(count: int | None) -> Iterator[Any]:
    """Worker processes on this machine, one run each at a time."""
    from distributed import LocalCluster

    # Ctrl+C in a terminal is for this process: workers end their runs when it asks them to. They
    # inherit the mask of the thread that starts them, and that the one of this thread.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        cluster = LocalCluster(
            n_workers=count or len(os.sched_getaffinity(0)),
            threads_per_worker=1,
            dashboard_address=None,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    with cluster:
        yield cluster


def _check_versions(client: Any) -> None:
    """Check that each worker has the NeuROS of this process. Raises ``EnvironmentFault``."""
    # A function of Python itself: what a worker cannot import would have it wait for ever.
    found = client.run(version, "neuros", on_error="return")
    here = version("neuros")
    for worker, there in found.items():
        if there != here:
            has = "no NeuROS" if isinstance(there, Exception) else f"NeuROS {there}"
            raise EnvironmentFault(
                f"executor dask: the worker {worker} has {has}, and this machine {here}: install"
                " the same there, in the Python that runs dask worker"
            )


def _resources_for(plan: SweepPlan, declared: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The resources of a job, under the names by which workers declare theirs.

    Dask counts only what its workers declare (``dask worker --resources "CPU=8 GPU=1"``), and a job
    that asks for more than any of them has would wait for ever. Raises ``EnvironmentFault``.
    """
    needs = plan.resources
    wanted = {"cpu": needs.cpus, "memory": needs.mem_bytes, "gpu": needs.gpus}
    names = {name: name.casefold().removesuffix("s") for each in declared for name in each}
    asked = {name: float(n) for name, word in names.items() if (n := wanted.get(word))}
    if declared and not any(
        all(each.get(name, 0.0) >= number for name, number in asked.items()) for each in declared
    ):
        text = ", ".join(f"{name}={number:g}" for name, number in asked.items())
        raise EnvironmentFault(
            f"executor dask: no worker has what a run of {plan.name} needs ({text}): start one"
            f' with dask worker --resources "{text.replace(",", "")}", or ask for less (resources)'
        )
    return asked


LOCAL = LocalExecutor()
DASK = DaskExecutor()
