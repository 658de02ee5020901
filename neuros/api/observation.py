"""System load and provenance of a run, for its record; statuses of its nodes while it goes on."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.backends.run_processes import RUN_ID
from neuros.control import GetStatus, Message, NodeStatus, Watch
from neuros.control.link import ControlLink

if TYPE_CHECKING:
    from neuros.api.plan import Plan
    from neuros.recording.system_load import LoadMonitor

HOST = "host"
"""The columns of all nodes together, where they share a process."""


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


def statuses(
    link: ControlLink, wanted: Callable[[], Mapping[str, Any]], period_s: float
) -> Iterator[NodeStatus]:
    """Statuses of all nodes, one each period, until the run is over.

    Args:
        link: to the supervisor; closed at the end.
        wanted: the samples to ask for next, by node.
    """
    for each in answers(link, lambda: [GetStatus(wanted())], period_s):
        if isinstance(each, NodeStatus):
            yield each


def answers(
    link: ControlLink, ask: Callable[[], Iterable[Message]], period_s: float
) -> Iterator[Message | None]:
    """What the supervisor sends, until the run is over; ``None`` once each period.

    Args:
        link: to the supervisor; closed at the end.
        ask: what to send to it, each period.
    """
    with closing(link):
        link.send(Watch())
        next_s = time.monotonic()
        while True:
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + period_s
                for message in ask():
                    link.send(message)
                yield None
            if not select.select([link], [], [], max(0.0, next_s - time.monotonic()))[0]:
                continue
            messages = link.receive()
            if messages is None:
                return
            yield from messages
