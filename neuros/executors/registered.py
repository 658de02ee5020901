"""Executors of sweeps: their interface, their registry, and the choice of ``--executor``."""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import Project
from neuros.registry import Registry

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
        return _left_open(wanted)
    name, equals, place = wanted.partition("=")
    executor = EXECUTORS.load(name)
    if equals and not (place and executor.place):
        what = f"give {name}={executor.place}" if executor.place else f"give {name} alone"
        raise UsageError(f"--executor {wanted}: {what}")
    return executor.open(place or None, plan)


@contextmanager
def _left_open(pool: Executor) -> Iterator[Jobs]:
    yield PoolJobs(pool)


def not_installed(package: str, extra: str) -> EnvironmentFault:
    """The fault that an executor's library is missing."""
    return EnvironmentFault(
        f"executor {extra}: {package} is not installed for {sys.executable}:"
        f" pip install 'neuros[{extra}]'"
    )
