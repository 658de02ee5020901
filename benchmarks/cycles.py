"""What a cycle of WhiskEye costs in one process: by NeuROS, by hand, and in one loop, within a run.

From run to run the same program takes up to a third more or less on a shared machine. Slices of a
few cycles of one run are hit alike (``benchmarks/by_hand/sitecustomize.py``).
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.launching import lines_from

BY_HAND = Path(__file__).resolve().parent / "by_hand"
NEUROS, HAND, APART, LOOP = "neuros", "by hand", "by hand, apart", "one loop"
_NEIGHBOURS = 12
_TAIL = 10
_MINIMUM_SLICES = 20


def speeds(project: Path, settings: dict[str, Any]) -> dict[str, float]:
    """How fast the nodes are in one process, and hooks called by hand, as shares of one loop.

    Returns:
        ``neuros``, ``by hand`` and ``by hand, apart`` (each hook in the surroundings of its node):
        share of the speed of ``floor.py``'s loop, and ``around hooks``: that of NeuROS in the speed
        of the same hooks called by hand. By the processor time of the thread that does all.

    Raises:
        RuntimeError: if the run fails, or is too short.
    """
    lines = lines_from(BY_HAND, "NEUROS_CYCLES", project, "in-process", settings=settings)
    costs = relative_costs([slice_of(line) for line in lines])
    return {
        NEUROS: costs[LOOP] / costs[NEUROS],
        HAND: costs[LOOP] / costs[HAND],
        APART: costs[LOOP] / costs[APART],
        "around hooks": costs[HAND] / costs[NEUROS],
    }


def slice_of(line: str) -> tuple[str, int]:
    """The mode of a slice and what a cycle of it cost, in nanoseconds."""
    cost_ns, mode = line.split(" ", 1)
    return mode, int(cost_ns)


def relative_costs(slices: Sequence[tuple[str, int]]) -> dict[str, float]:
    """The cost of each mode, in shares of what NeuROS costs about the same time.

    Each slice is divided by the median of NeuROS's slices among its neighbours, so that a machine
    that changes its pace changes nothing; then the mean of each mode without its extreme tenths.

    Raises:
        RuntimeError: if there are too few slices.
    """
    if len(slices) < _MINIMUM_SLICES:
        raise RuntimeError(f"only {len(slices)} slices: the run is too short")
    found: dict[str, list[float]] = {}
    for place, (mode, cost_ns) in enumerate(slices):
        around = slices[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]
        usual_ns = statistics.median([cost for other, cost in around if other == NEUROS] or [0])
        if usual_ns:
            found.setdefault(mode, []).append(cost_ns / usual_ns)
    return {mode: _trimmed_mean(costs) for mode, costs in found.items()}


def _trimmed_mean(values: Sequence[float]) -> float:
    tail = len(values) // _TAIL
    return statistics.fmean(sorted(values)[tail : len(values) - tail])
