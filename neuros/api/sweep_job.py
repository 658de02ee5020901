"""One run of a sweep as a job, which is sent to an executor, and the row that comes back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuros.analysis.run_record import consumed_percent
from neuros.api.live import LiveRun
from neuros.api.project import Project
from neuros.api.run import Run
from neuros.caching import locked
from neuros.errors import NeurosError

# A run that was interrupted, or could not write what it should, is made again.
_FINISHED = (0, 1, 5)
SHARE = ": consumed / %"
_LOOK_S = 0.25


@dataclass(frozen=True)
class SweepJob:
    """A run of a sweep. Calling it makes the run, wherever it was sent.

    Several jobs of the same run do no harm, as after the front end of a sweep was killed, or where
    Dask has taken a worker for lost: one makes it, and the others return its row.

    Attributes:
        values: what the row begins with.
        arguments: of :meth:`Project.start`.
        folder: of the run.
        stop: a file; as soon as it is there, the run is ended, and none begins.
    """

    project: Project
    values: Mapping[str, Any]
    arguments: Mapping[str, Any]
    folder: Path
    stop: Path

    def __call__(self) -> dict[str, Any] | None:
        """Make the run; returns its row, ``None`` if the sweep was ended before."""
        try:
            with locked(self.folder.with_name(f".{self.folder.name}.lock")):
                return None if self.stop.exists() else self._row_of_another() or self._make()
        except (NeurosError, OSError) as error:
            return failed_row(self.values, error, self.folder)

    def _row_of_another(self) -> dict[str, Any] | None:
        """The row of the run if another job has made it; what is left of one is set aside."""
        if not self.folder.exists():
            return None
        run = finished_run(self.folder)
        if run is None:
            set_aside(self.folder)
        return None if run is None else row_of(self.values, run)

    def _make(self) -> dict[str, Any] | None:
        live: LiveRun | None = None
        try:
            live = self.project.start(**self.arguments, output=self.folder)
            run = self._ended(live)
        except KeyboardInterrupt:  # of a cluster that wants its machine back
            if live is None:
                raise
            live.end()
            run = Run(live.folder)
        is_cut_off = run.exit_code not in _FINISHED and self.stop.exists()
        return None if is_cut_off else row_of(self.values, run)

    def _ended(self, live: LiveRun) -> Run:
        while not self.stop.exists():
            try:
                return live.wait(_LOOK_S)
            except TimeoutError:
                continue
        live.interrupt()
        return live.wait()


def finished_run(folder: Path) -> Run | None:
    """The run that a folder holds, unless it was cut off."""
    try:
        run = Run(folder)
    except NeurosError:
        return None
    return run if run.exit_code in _FINISHED else None


def set_aside(folder: Path, why: str = "unfinished") -> None:
    """Rename what a run has left that is made again."""
    number = 1
    while (aside := folder.with_name(f"{folder.name}.{why}-{number}")).exists():
        number += 1
    folder.rename(aside)


def row_of(values: Mapping[str, Any], run: Run) -> dict[str, Any]:
    """What came of a run, behind the values that it was made with."""
    row = {
        **values,
        "exit_code": run.exit_code,
        "reason": run.reason,
        "wall_s": run.wall_s,
        "sim_s": run.sim_s,
        "real_time_factor": run.real_time_factor,
    }
    for name, connection in run.connections.items():
        sent, consumed = connection["sent"], connection["consumed"]
        row[f"{name}: sent"] = sent
        row[f"{name}: consumed"] = consumed
        row[f"{name}{SHARE}"] = consumed_percent(connection)
    for node, results in run.node_results.items():
        row |= {f"{node}.{name}": value for name, value in results.items()}
    return {**row, "folder": str(run.folder)}


def failed_row(values: Mapping[str, Any], error: BaseException, folder: Path) -> dict[str, Any]:
    """The row of a run that could not begin, or whose job was lost."""
    return {**values, "exit_code": None, "reason": f"not made: {error}", "folder": str(folder)}
