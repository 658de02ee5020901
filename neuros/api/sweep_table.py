"""The table of a sweep: a row for each run, whatever became of it."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.api.run import Run
from neuros.observe.run_record import consumed_percent

CSV_NAME = "sweep.csv"
_REASON_CHARACTERS = 50
_COUNTS = (": sent", ": consumed")
_SHARE = ": consumed / %"


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
        row[f"{name}{_SHARE}"] = consumed_percent(connection)
    for node, results in run.node_results.items():
        row |= {f"{node}.{name}": value for name, value in results.items()}
    return {**row, "folder": str(run.folder)}


def failed_row(values: Mapping[str, Any], error: Exception, folder: Path) -> dict[str, Any]:
    """The row of a run that could not begin."""
    return {**values, "exit_code": None, "reason": f"not started: {error}", "folder": str(folder)}


def columns_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The columns of all rows; that of the folder is the last."""
    found = dict.fromkeys(name for row in rows for name in row)
    found.pop("folder", None)
    return [*found, "folder"]


def write_csv(rows: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write ``sweep.csv``; whoever reads it never finds half of it. Raises ``OSError``."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns_of(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    new = folder / f"{CSV_NAME}.new"
    new.write_text(text.getvalue(), "utf-8")
    os.replace(new, folder / CSV_NAME)


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """For people: without folders, times and counts."""
    from tabulate import tabulate

    hidden = ("folder", "wall_s", "sim_s")
    names = [n for n in columns_of(rows) if n not in hidden and not n.endswith(_COUNTS)]
    names = [name for name in names if any(_is_shown(row.get(name)) for row in rows)]
    table: str = tabulate(
        [[_cell(name, row.get(name)) for name in names] for row in rows],
        headers=[name.replace(": ", "\n").replace(" -> ", "\n-> ") for name in names],
        disable_numparse=True,
    )
    return table


def _is_shown(value: Any) -> bool:
    return value is not None and not isinstance(value, (list, dict))


def _cell(name: str, value: Any) -> str:
    if value is None or isinstance(value, (list, dict)):
        return ""
    if name.endswith(_SHARE):
        return f"{value:.1f}"
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    if name == "reason" and len(text) > _REASON_CHARACTERS:
        return text[: _REASON_CHARACTERS - 3] + "..."
    return text
