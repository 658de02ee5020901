"""A run that is over, for Python programs."""

from __future__ import annotations

import html
import json
import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.api.kept import kept_value
from neuros.api.run_record import PastRun, open_run, run_table
from neuros.errors import RunError
from neuros.project.scanner import read_bytes
from neuros.registry import BAG_FORMATS

if TYPE_CHECKING:
    from neuros.bag import Bag


class Run(PastRun):
    """Result of a run: its end, its figures, its packets, its logs.

    Attributes:
        folder: the run folder.
        record: the content of ``run.json``, which has all figures.

    Args:
        folder: of a run that has ended.

    Raises:
        UsageError: if the folder has no run, or one of another version of NeuROS.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        path = Path(folder).absolute()
        super().__init__(path, open_run(path).record)

    @classmethod
    def unwritten(cls, folder: Path, record: Mapping[str, Any]) -> Run:
        """A run whose ``run.json`` could not be written."""
        run = cls.__new__(cls)
        PastRun.__init__(run, folder, json.loads(json.dumps(record)))
        return run

    @property
    def project(self) -> str:
        """The name of the project."""
        return str(self.record["project"])

    @property
    def backend(self) -> str:
        """``docker``, ``process`` or ``in-process``."""
        return str(self.record["backend"])

    @property
    def exit_code(self) -> int:
        """0 normal end; 1 a node failed or was killed, a deadlock, or loss on a lossless
        connection; 4 a record was not written; 5 a budget was broken; 7 the program
        that held it failed; 130 Ctrl+C; 143 SIGTERM.
        """
        return int(self.record["exit_code"])

    @property
    def reason(self) -> str:
        """Why the run ended, in one line."""
        return str(self.record["reason"])

    @property
    def is_ok(self) -> bool:
        """Whether the run ended normally."""
        return self.exit_code == 0

    @property
    def wall_s(self) -> float:
        """Wall time from the first hook to the end, in seconds."""
        return float(self.record["wall_s"])

    @property
    def sim_s(self) -> float | None:
        """Simulated time in seconds, ``None`` if no node owns time."""
        return _number(self.record["sim_s"])

    @property
    def real_time_factor(self) -> float | None:
        """Simulated time by wall time, without initialisation and ending."""
        return _number(self.record["real_time_factor"])

    @property
    def node_results(self) -> dict[str, Mapping[str, Any]]:
        """Results of plugins (``node.set_result``), by node and name."""
        return {name: node.get("results", {}) for name, node in self.nodes.items()}

    def connection_frame(self) -> Any:
        """A ``pandas.DataFrame`` with a row for each connection; made by an extension."""
        return BAG_FORMATS.load("connections")(self)

    def node_frame(self) -> Any:
        """A ``pandas.DataFrame`` of seconds by cause, a row for each node; made by an extension."""
        return BAG_FORMATS.load("nodes")(self)

    @cached_property
    def bag(self) -> Bag:
        """The recorded packets, as :func:`neuros.bag.open` returns them.

        Raises:
            UsageError: if nothing was recorded.
            EnvironmentFault: if the bag is damaged.
        """
        from neuros.bag import open_bag

        return open_bag(self.folder)

    def kept(self, value: str) -> Any:
        """What a node has kept with ``node.keep``, by its name: ``run.kept("brain.weights")``.

        Raises:
            UsageError: if the run has kept nothing of that name.
        """
        return kept_value(self.folder, value)

    def log(self, node: str) -> str:
        """The log and output of a node.

        Raises:
            KeyError: if the run has no such node.
        """
        if node not in self.nodes:
            raise KeyError(f"{node}: there are {', '.join(self.nodes)}")
        file = self.folder / node / "node.log"
        return read_bytes(file).decode("utf-8", "replace") if file.exists() else ""

    def check(self) -> Run:
        """Return this run.

        Raises:
            RunError: if the run did not end normally.
        """
        if not self.is_ok:
            broken = self.record.get("broken_budgets") or []
            lines = dict.fromkeys([self.reason, *(f"budget broken: {text}" for text in broken)])
            raise RunError("\n".join([*lines, f"run folder: {self.folder}"]), self.exit_code)
        return self

    def __str__(self) -> str:
        return f"{run_table(self.record)}\n{self.reason}\nrun folder: {self.folder}"

    def __repr__(self) -> str:
        return f"<Run of {self.project}: exit code {self.exit_code}, {self.reason}; {self.folder}>"

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
