"""What a run is watched with: the options for it, and what is composed from them."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.errors import EnvironmentFault
from neuros.launch.run_processes import RUN_ID
from neuros.project.model import Project

if TYPE_CHECKING:
    from neuros.observe.monitor import LoadMonitor

HOST = "host"
"""The columns of all nodes together, where they share a process."""


def add_observation(launch: argparse.ArgumentParser) -> None:
    """Add the options of ``neuros launch``."""
    launch.add_argument(
        "-m",
        "--monitor-system-load",
        action="store_true",
        help="write processor, memory, network and threads, of the machine and by node, to"
        " system_load.csv in the run folder, once per second",
    )

    launch.add_argument(
        "--digests",
        action="store_true",
        help="also in process, keep a digest of every packet for `neuros verify`; each packet is"
        " serialised for it there (on the other back ends digests are always kept)",
    )


def check_observation(options: argparse.Namespace) -> None:
    """Whether what is asked for is installed. Raises ``EnvironmentFault``."""
    if options.monitor_system_load and find_spec("psutil") is None:
        raise EnvironmentFault(
            "--monitor-system-load needs the package psutil: run install.py again, or pip install"
            " psutil"
        )


class Observation:
    """Watches one run, as the options say.

    Args:
        names: the nodes that are started.
        is_one_process: whether they share a process, so that no figure is one node's alone.
    """

    def __init__(
        self,
        options: argparse.Namespace,
        run_id: str,
        run_folder: Path,
        project: Project,
        names: Sequence[str],
        *,
        is_one_process: bool,
    ) -> None:
        self._run_id = run_id
        self._run_folder = run_folder
        self._project = project
        from neuros.observe.provenance import GitState

        self._git = GitState(project.folder)
        self._monitor: LoadMonitor | None = None
        if options.monitor_system_load:
            self._monitor = _monitor(run_id, run_folder, names, is_one_process=is_one_process)
            self._monitor.start()

    def finish(self) -> tuple[dict[str, Any], list[str]]:
        """End it; returns what belongs into the run's record, and what has gone wrong."""
        from neuros.observe.provenance import provenance

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


def _monitor(
    run_id: str, run_folder: Path, names: Sequence[str], *, is_one_process: bool
) -> LoadMonitor:
    from neuros.observe.load import LAUNCHER, LoadMeter
    from neuros.observe.load_table import LoadTable
    from neuros.observe.monitor import LoadMonitor

    groups = [HOST] if is_one_process else list(names)
    table = LoadTable([*groups, LAUNCHER], os.cpu_count() or 1)
    meter = LoadMeter(owner_of_processes(run_id, names, is_one_process=is_one_process))
    return LoadMonitor(run_folder, meter, table)


def owner_of_processes(
    run_id: str, names: Sequence[str], *, is_one_process: bool
) -> Callable[[Mapping[str, str]], str | None]:
    """What tells whose a process of a run is, by the environment that it was started with."""

    def owner(environment: Mapping[str, str]) -> str | None:
        if environment.get(RUN_ID) != run_id:
            return None
        if is_one_process:  # its threads belong to no node in particular
            return HOST
        # The node's own folder, wherever that is for a node in a container.
        name = os.path.basename(environment.get("NEUROS_RUN_DIR", "").rstrip("/"))
        return name if name in names else None

    return owner
