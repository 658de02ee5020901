"""System load and provenance of a run, for its record."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.backends.run_processes import RUN_ID
from neuros.errors import EnvironmentFault

if TYPE_CHECKING:
    from neuros.api.plan import Plan
    from neuros.recording.system_load import LoadMonitor

HOST = "host"
"""The columns of all nodes together, where they share a process."""


def check_observation(*, monitors_load: bool) -> None:
    """Raise ``EnvironmentFault`` if the load is to be monitored, and psutil is not installed."""
    if monitors_load and find_spec("psutil") is None:
        raise EnvironmentFault(
            "--monitor-system-load needs the package psutil, which is missing: pip install psutil"
        )


class Observation:
    """Collects the provenance of a run, and monitors the system load if the plan asks for it."""

    def __init__(self, plan: Plan, run_id: str, run_folder: Path) -> None:
        from neuros.recording.provenance import GitState

        self._run_id = run_id
        self._run_folder = run_folder
        self._project = plan.project
        self._git = GitState(plan.project.folder)
        self._monitor: LoadMonitor | None = None
        if plan.request.monitor_system_load:
            is_one_process = plan.back_end.is_one_process
            self._monitor = load_monitor(
                run_id, run_folder, plan.names, is_one_process=is_one_process
            )
            self._monitor.start()

    def finish(self) -> tuple[dict[str, Any], list[str]]:
        """Stop; returns entries of ``run.json``, and a sentence for each failure."""
        from neuros.recording.provenance import provenance

        record = {
            "run_id": self._run_id,
            **provenance(sys.argv, self._project.nodes, self._run_folder),
            "git": self._git.finish(),
        }
        if self._monitor is None:
            return record, []
        record["system_load"] = self._monitor.stop()
        failure = self._monitor.failure
        return record, [] if failure is None else [failure]


def load_monitor(
    run_id: str, run_folder: Path, names: Sequence[str], *, is_one_process: bool
) -> LoadMonitor:
    """The monitor that writes the system load of a run.

    Args:
        names: nodes of the run.
        is_one_process: whether they share a process, so that they have figures only together.
    """
    from neuros.recording.system_load import LAUNCHER, LoadMeter, LoadMonitor, LoadTable

    groups = [HOST] if is_one_process else list(names)
    table = LoadTable([*groups, LAUNCHER], os.cpu_count() or 1)
    meter = LoadMeter(owner_of_processes(run_id, names, is_one_process=is_one_process))
    return LoadMonitor(run_folder, meter, table)


def owner_of_processes(
    run_id: str, names: Sequence[str], *, is_one_process: bool
) -> Callable[[Mapping[str, str]], str | None]:
    """A function from the environment of a process to its node, ``None``: not of this run."""

    def owner(environment: Mapping[str, str]) -> str | None:
        if environment.get(RUN_ID) != run_id:
            return None
        if is_one_process:
            return HOST
        # The path differs in a container; the name of the folder does not.
        name = os.path.basename(environment.get("NEUROS_RUN_DIR", "").rstrip("/"))
        return name if name in names else None

    return owner
