"""Does the ring find the heading that its eyes see, however far off it starts?

What is seen is off by 2 degrees at random; the robot stands, or turns at 1 rad/s. For each start:
the time after which the ring stays within 10 degrees, with the current that insists
(``correction.py``) and without. Writes ``wrong_start.csv``, a line per run, and a figure::

    python wrong_start.py --seeds 3 -o build/wrong_start
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from correction import INSISTING, CorrectedIntegrator
from numpy.typing import NDArray

STARTS_DEG = (-150.0, -90.0, -45.0, 60.0, 120.0, 160.0, 175.0, 180.0)
RATES_RAD_S = (0.0, 1.0)
LOOKED_S, PERIOD_S, FRAME = 5.0, 0.02, 5  # every fifth packet of the IMU has pictures
DEVIATION_RAD = math.radians(2.0)  # of what is seen
WITHIN_DEG = 10.0

Found = Mapping[tuple[float, float, float], Sequence[float | None]]
"""By insisting, rate and start: for each seed after how many seconds it was right."""


def errors_deg(
    start_deg: float, rate_rad_s: float, seed: int, insisting: float = INSISTING
) -> NDArray[np.float64]:
    """Errors of the corrected ring, every 20 ms for 5 s, in degrees ``(250,)``."""
    integrator = CorrectedIntegrator(
        seed, 0.0, 300.0, 0.12, start_rad=math.radians(start_deg), insisting=insisting
    )
    rng = np.random.default_rng(seed)
    errors = []
    for step in range(1, round(LOOKED_S / PERIOD_S) + 1):
        stamp_ns, true_rad = round(step * PERIOD_S * 1e9), rate_rad_s * step * PERIOD_S
        if step % FRAME == 0:
            seen_rad = true_rad + rng.normal(0.0, DEVIATION_RAD)
            integrator.vision.see(stamp_ns, seen_rad, 0.02, DEVIATION_RAD)
        heading_rad, _ = integrator.integrate(stamp_ns, rate_rad_s)
        errors.append(math.degrees(math.remainder(heading_rad - true_rad, math.tau)))
    return np.array(errors)


def found_after_s(errors: NDArray[np.float64]) -> float | None:
    """After which time it stays within 10 degrees; ``None``: it does not by the end."""
    off = np.flatnonzero(np.abs(errors) > WITHIN_DEG)
    steps = off[-1] + 1 if off.size else 0
    return None if steps == len(errors) else round(steps * PERIOD_S, 2)


def draw(found: Found, file: Path) -> None:
    """The times by start, a panel per current; above the line: it was not found in 5 s."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    every = figure.subplots(1, 2, sharey=True)
    for axes, (insisting, title) in zip(
        every, ((INSISTING, "the current insists"), (0.0, "it does not")), strict=True
    ):
        for rate_rad_s, marker, offset in ((0.0, "o", -2.0), (1.0, "^", 2.0)):
            points = [
                (start + offset, LOOKED_S + 0.4 if time_s is None else time_s)
                for (kind, rate, start), times in found.items()
                for time_s in times
                if (kind, rate) == (insisting, rate_rad_s)
            ]
            label = f"turns at {rate_rad_s:g} rad/s" if rate_rad_s else "stands"
            axes.plot(*zip(*points, strict=True), marker, ms=4, mfc="none", label=label)
        axes.axhline(LOOKED_S, color="0.6", linewidth=1)
        axes.set_title(title, loc="left", fontsize=10)
        axes.set(xlabel="off at the start (deg)", xticks=range(-180, 181, 60), ylim=(-0.2, 5.8))
    every[0].set(ylabel="right after (s)", yticks=[*range(5), 5.4])
    every[0].set_yticklabels(["0", "1", "2", "3", "4", "never"])
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    figure.savefig(file, dpi=110, metadata={"Software": None})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="of ring and vision: 1 to this one")
    parser.add_argument("-o", "--output", type=Path, default=Path("build/wrong_start"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    found: dict[tuple[float, float, float], list[float | None]] = {}
    with (options.output / "wrong_start.csv").open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["insisting", "rate_rad_s", "start_deg", "seed", "found_after_s"])
        for seed in range(1, options.seeds + 1):
            for insisting in (INSISTING, 0.0):
                for rate in RATES_RAD_S:
                    for start in STARTS_DEG:
                        time_s = found_after_s(errors_deg(start, rate, seed, insisting))
                        found.setdefault((insisting, rate, start), []).append(time_s)
                        rows.writerow([insisting, rate, start, seed, time_s])
                        stream.flush()
    draw(found, options.output / "wrong_start.png")


if __name__ == "__main__":
    main()
