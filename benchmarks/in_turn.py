"""What a part of NeuROS costs a run, measured within the run: it is taken out and put back in turn.

Two runs of one program differ by a third on a busy machine, so a cost of a few per cent cannot be
seen from run to run. Slices of one run that follow each other differ less, and there are many.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.launching import lines_from

SWITCH = Path(__file__).resolve().parent / "switch"
_SETTLING_PAIRS = 1
_INCOMPLETE_BAG = 4


def speed_with(
    part: str,
    project: Path,
    backend: str,
    slice_s: float,
    settings: dict[str, Any],
    options: Sequence[str] = (),
) -> dict[str, float]:
    """How fast the node that owns simulated time is with a part, as a share of without it.

    ``speed`` is by the wall clock; ``work`` by the processor time of its thread, which is of use in
    process, where that thread does all. The medians over the pairs of slices of one run. Parts are
    those of ``switch/sitecustomize.py``.

    Raises:
        RuntimeError: if the run fails, or is too short for slices of this length.
    """
    lines = lines_from(
        SWITCH,
        "NEUROS_SLICES",
        project,
        backend,
        settings=settings,
        options=options,
        environment={"NEUROS_PART": part, "NEUROS_SLICE_NS": str(round(slice_s * 1e9))},
        codes=(0, _INCOMPLETE_BAG),
    )
    pairs = pairs_of(lines)[_SETTLING_PAIRS:]
    if not pairs:
        raise RuntimeError(f"{project.name}: no two slices of {slice_s} s in the run")
    return {
        name: statistics.median(whole[place] / less[place] for whole, less in pairs)
        for place, name in enumerate(("speed", "work"))
    }


def pairs_of(lines: Iterable[str]) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Hook executions per nanosecond, wall and processor time, with the part and without it."""
    pairs: dict[int, dict[bool, tuple[float, float]]] = {}
    for line in lines:
        number, is_whole, runs, took_ns, worked_ns = map(int, line.split())
        pairs.setdefault(number // 2, {})[bool(is_whole)] = runs / took_ns, runs / worked_ns
    return [(pair[True], pair[False]) for _, pair in sorted(pairs.items()) if len(pair) == 2]
