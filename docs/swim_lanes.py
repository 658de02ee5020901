#!/usr/bin/env python3
"""Makes the swim lanes of the orchestration guide: WhiskEye in four orchestrations, as it ran.

::

    .venv/bin/python docs/swim_lanes.py [NAME ...]

It needs what WhiskEye needs. Run it where nothing else runs, and look at what it has made.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from neuros_analysis.charts import timeline_figure
from neuros_analysis.review import open_for_review
from neuros_analysis.run_pages import picture

import neuros

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures"
WHISKEYE = ROOT / "examples" / "4_neurorobotics" / "whiskeye"
# By project file: how long the physics goes on, in simulated seconds, and what else is set. Strict
# as it is lets 50 packets wait for the figure; with room for one, the first second shows who waits
# for whom. Without limits the physics would be over before the network has started.
RUNS: dict[str, tuple[int, dict[str, int]]] = {
    "strict": (
        6,
        {
            "connections.robot.pose.visualiser.truth.queue_size": 1,
            "connections.snn.estimate.visualiser.estimate.queue_size": 1,
        },
    ),
    "project": (6, {}),
    "no_discard_limit": (90, {}),
    "asynchronous": (6, {}),
}


def draw(name: str, folder: Path) -> None:
    """Run one of them, and write its figure."""
    simulated_s, settings = RUNS[name]
    neuros.Project.from_file(WHISKEYE / f"{name}.json").run(
        set={"nodes.robot.environment.DURATION": simulated_s, **settings},
        backend="process",
        output=folder,
        check=True,
    )
    figure = timeline_figure(open_for_review(folder))
    assert figure is not None
    (FIGURES / f"swim_lanes_{name}.png").write_bytes(picture(figure))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(RUNS)} (all)")
    names = parser.parse_args().names or [*RUNS]
    if unknown := [name for name in names if name not in RUNS]:
        parser.error(f"there is no {unknown[0]}; there are {', '.join(RUNS)}")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            draw(name, Path(folder) / name)
