"""Runs of sweeps on the workers of a Dask scheduler."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import SweepExecutor, SweepPlan

_ANSWER_S = 20.0  # of a Dask scheduler


def not_installed(package: str, extra: str) -> EnvironmentFault:
    """The fault that an executor's library is missing."""
    return EnvironmentFault(
        f"executor {extra}: {package} is not installed for {sys.executable}:"
        f" pip install 'neuros[{extra}]'"
    )


class DaskExecutor(SweepExecutor):
    """Runs on the workers of a Dask scheduler; without an address, on workers of this machine."""

    name = "dask"
    place = "ADDRESS"

    @contextmanager
    def open(self, place: str | None, plan: SweepPlan) -> Iterator[Executor]:
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
            _check_versions(client, plan.distribution)
            workers = client.scheduler_info(n_workers=-1)["workers"].values()
            resources = _resources_for(plan, [worker["resources"] for worker in workers])
            yield client.get_executor(pure=False, resources=resources)


@contextmanager
def _local_cluster(count: int | None) -> Iterator[Any]:
    """Worker processes on this machine, one run each at a time."""
    from distributed import LocalCluster

    # Ctrl+C in a terminal is for this process: it asks workers to end their runs. Workers inherit
    # the signal mask of the thread that starts them, which inherits that of this thread.
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


def _check_versions(client: Any, distribution: str) -> None:
    """Check that each worker has the NeuROS of this process. Raises ``EnvironmentFault``."""
    # A function of Python itself: a worker would wait for ever for one that it cannot import.
    found = client.run(version, distribution, on_error="return")
    here = version(distribution)
    for worker, there in found.items():
        if there != here:
            is_missing = isinstance(there, Exception)
            has = f"no {distribution}" if is_missing else f"{distribution} {there}"
            raise EnvironmentFault(
                f"executor dask: the worker {worker} has {has}, and this machine {here}: install"
                " the same there, in the Python that runs dask worker"
            )


def _resources_for(plan: SweepPlan, declared: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The resources of a job, under the names by which workers declare theirs.

    Dask counts only the resources that workers declare (``dask worker --resources "CPU=8 GPU=1"``),
    and a job that asks for more than any worker has would wait for ever. Raises
    ``EnvironmentFault``.
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


DASK = DaskExecutor()
