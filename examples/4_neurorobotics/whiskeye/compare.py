"""Puts runs side by side: how fast, what was lost on the way, how far off. Prints Markdown.

    python compare.py RUN...

Each RUN is a run folder with ``run.json`` and ``visualiser/head_direction.json`` in it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

IMU = ("robot.imu -> snn.imu",)
PLOT = ("robot.pose -> visualiser.truth", "snn.estimate -> visualiser.estimate")
COLUMNS = ("project file", "back end", "physics", "IMU", "to the plot", "estimates", "RMS", "max.")


@dataclass(frozen=True)
class Row:
    """One run.

    Attributes:
        name: the project file.
        physics: real-time factor of the physics.
        imu, plot: packets that were consumed, of those that were sent; ``None`` if none was.
        estimates: of the heading, that were compared with the truth.
        rms_deg, max_deg: of their error; ``None`` where nothing could be compared.
    """

    name: str
    backend: str
    physics: float | None
    imu: float | None
    plot: float | None
    estimates: int
    rms_deg: float | None
    max_deg: float | None

    def cells(self) -> tuple[str, ...]:
        """The row as text, in the order of the columns."""
        return (
            f"`{self.name}`",
            self.backend,
            _shown(self.physics, "{:.2f}"),
            _shown(self.imu, "{:.1%}"),
            _shown(self.plot, "{:.1%}"),
            str(self.estimates),
            _shown(self.rms_deg, "{:.2f}"),
            _shown(self.max_deg, "{:.2f}"),
        )


def read_run(folder: Path) -> Row:
    """Read a run folder. Raises ``OSError`` where it is not one of this example."""
    run = json.loads((folder / "run.json").read_text())
    error = json.loads((folder / "visualiser/head_direction.json").read_text())
    counters = {each["connection"]: each for each in run["connections"]}

    def share(names: Sequence[str]) -> float | None:
        sent = sum(counters[name]["sent"] or 0 for name in names)
        return sum(counters[name]["consumed"] or 0 for name in names) / sent if sent else None

    return Row(
        name=Path(run["file"]).name,
        backend=run["backend"],
        physics=run["real_time_factor"],
        imu=share(IMU),
        plot=share(PLOT),
        estimates=error["samples"],
        rms_deg=error["rms_deg"],
        max_deg=error["max_deg"],
    )


def table(rows: Sequence[Row]) -> str:
    """A Markdown table, one line per run."""
    lines = [COLUMNS, ("---",) * len(COLUMNS), *(row.cells() for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path, help="a run folder")
    print(table([read_run(folder) for folder in parser.parse_args().runs]))


if __name__ == "__main__":
    main()
