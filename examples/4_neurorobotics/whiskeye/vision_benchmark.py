"""Who reads the heading off a view best, and who knows when not: predictive coding and baselines.

Ten rooms, drawn by seed. In each, pixels, random features, a small CNN and the predictive coding
network learn from the same views; the same read-out tells the heading (``decoders.py``). They are
asked at headings and places that were held out, with noise, behind an occluder, outside the disc of
places that was learnt, and after the cues have changed their colours. A gate lets those views pass
that are no more uncertain than 95 % of the validation views. At last the robot drives for 161 s,
with noise and a drifting bias of its gyroscope, an occluder, noisy pictures and a kidnapping; a
Bayes filter weighs each heading by its uncertainty, as ``trainer.py`` measures it::

    python vision_benchmark.py --seeds 10 -o build/vision

It writes ``views.csv``, ``coverage.csv`` and ``drives.csv``, with rows for each seed, ``table.md``,
with means and their 95 % intervals over seeds, and ``vision_benchmark.png``.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from decoders import Causes, Pixels, RandomFeatures, ReadOut, SmallCNN, off_deg, rms
from held_out import split
from numpy.typing import NDArray
from rooms import Eyes, room
from views import CODES, HEIGHT, PIXELS, WIDTH, code_of, standardised
from wandering import RADIUS_M, Wanderer

Floats = NDArray[np.float32]

LEARNT, VALIDATED, TESTED = 800, 120, 120
OUTSIDE_M = (1.2, 1.8)
NOISE = (40.0, 100.0)  # grey levels of each pixel of the camera
BLOCK = 25  # pixels of the camera of which a value of a view is the mean
OCCLUDED = 0.25  # share of the columns of each eye
GATE = 0.12  # of correction.py
SHIPPED = f"view {GATE:g}"
PASSED = 0.95  # of the validation views pass a gate
DRIVE_S, PICTURE_S, STEP_S = 161.0, 0.5, 0.02
GYRO_NOISE, BIAS, BIAS_DRIFT = 0.02, 0.05, 0.005  # rad/s, rad/s, rad/s per root of a second
KIDNAPPED_S, DARK_S, NOISY_S = 60.0, (100.0, 110.0), (130.0, 140.0)
TOLD_WITHIN_DEG = 10.0
UNCERTAIN_RATE = 0.05  # rad/s, of the gyroscope's bias, as the filter expects it
LOST = 1e-3  # how likely the filter takes a kidnapping to be, per picture
WRONG = 0.02  # how likely it takes a heading that was seen to be wrong altogether
COVERAGES = np.linspace(0.05, 1.0, 20)

CONDITIONS = (
    *("headings", "places", "noise 40", "noise 100", "occluded", "outside", "colours changed"),
)


def poses(
    rng: np.random.Generator,
    count: int,
    part: str = "learnt",
    radius_m: tuple[float, float] = (0, RADIUS_M),
) -> NDArray[np.float64]:
    """So many poses, evenly in a ring, of one part of ``held_out.py``: ``(count, 3)``."""
    found = np.empty((0, 3))
    while len(found) < count:
        angle, heading = rng.uniform(-math.pi, math.pi, (2, 1000))
        away = np.sqrt(rng.uniform(radius_m[0] ** 2, radius_m[1] ** 2, 1000))
        places = (away * [np.cos(angle), np.sin(angle)]).T
        drawn = np.column_stack([places, heading])
        kept = getattr(split(heading % math.tau, places), part)
        found = np.concatenate([found, drawn[kept]])
    return found[:count]


def noisy(small: Floats, deviation: float, rng: np.random.Generator) -> Floats:
    """Mean colours ``(n, 1152)`` of pictures whose pixels have white noise."""
    noise = rng.normal(0.0, deviation / math.sqrt(BLOCK), small.shape)
    return np.clip(small + noise, 0, 255).astype(np.float32)


def occluded(small: Floats, rng: np.random.Generator) -> Floats:
    """Mean colours ``(n, 1152)`` with a bar of one colour in front of each eye."""
    eyes = small.reshape(-1, 2, HEIGHT, WIDTH, 3).copy()
    width = round(OCCLUDED * WIDTH)
    for view in eyes:
        colour = rng.uniform(0, 255, 3)
        for eye in view:
            left = rng.integers(0, WIDTH - width + 1)
            eye[:, left : left + width] = colour
    return eyes.reshape(-1, PIXELS)


def seen(seed: int) -> dict[str, tuple[NDArray[np.float64], Floats]]:
    """Poses ``(n, 3)`` and mean colours ``(n, 1152)`` of all that is learnt and asked."""
    rng = np.random.default_rng([seed, 1])
    eyes = Eyes(room(seed))
    asked = {
        "learnt": poses(rng, LEARNT),
        "validation": poses(rng, VALIDATED),
        "headings": poses(rng, TESTED, "headings"),
        "places": poses(rng, TESTED, "places"),
        "outside": poses(rng, TESTED, radius_m=OUTSIDE_M),
        "drive": driven(seed),
    }
    found = {name: (each, eyes.see(each)) for name, each in asked.items()}
    eyes.recolour()
    at, small = found["headings"]
    found["colours changed"] = at, eyes.see(at)
    eyes.close()
    for deviation in NOISE:
        found[f"noise {deviation:g}"] = at, noisy(small, deviation, rng)
    found["occluded"] = at, occluded(small, rng)
    at, small = found["drive"]
    times_s = PICTURE_S * (1 + np.arange(len(at)))
    small[_during(times_s, DARK_S)] = occluded(small[_during(times_s, DARK_S)], rng)
    small[_during(times_s, NOISY_S)] = noisy(small[_during(times_s, NOISY_S)], NOISE[1], rng)
    return found


# ---------------------------------------------------------------------- driving


def driven(seed: int) -> NDArray[np.float64]:
    """Poses at each picture of a drive in the disc, ``(322, 3)``; at 60 s it is carried away."""
    way = Wanderer(1.0, randomise=True, speed_m_s=0.2, seed=seed)
    rng = np.random.default_rng([seed, 2])
    x, y, heading = 0.0, 0.0, 0.0
    found = []
    for step in range(1, round(DRIVE_S / STEP_S) + 1):
        vx, vy, rate = way.velocities(step * STEP_S, x, y)
        x, y, heading = x + vx * STEP_S, y + vy * STEP_S, heading + rate * STEP_S
        if step == round(KIDNAPPED_S / STEP_S):
            x, y = -x, -y
            heading += rng.choice([-1, 1]) * rng.uniform(math.pi / 2, math.pi)
        if step % round(PICTURE_S / STEP_S) == 0:
            found.append((x, y, heading))
    return np.array(found)


def measured_rad(seed: int, headings_rad: NDArray[np.floating]) -> NDArray[np.float64]:
    """How far a gyroscope says that the robot has turned since the picture before, ``(n,)``.

    It has noise and a drifting bias, as the sensors of the simulator, and does not feel that it is
    carried away.
    """
    rng = np.random.default_rng([seed, 3])
    turned = np.diff(headings_rad, prepend=0.0)
    turned[round(KIDNAPPED_S / PICTURE_S) - 1] = 0.0
    steps = BIAS_DRIFT * math.sqrt(PICTURE_S) * rng.standard_normal(len(turned))
    white = GYRO_NOISE * math.sqrt(STEP_S * PICTURE_S) * rng.standard_normal(len(turned))
    return turned + (BIAS + np.cumsum(steps)) * PICTURE_S + white


class HeadingFilter:
    """A ring without neurons: how likely each of 180 headings is, by Bayes' rule."""

    def __init__(self) -> None:
        self._headings = np.arange(CODES) * math.tau / CODES
        self._likely = np.zeros(CODES)
        self._likely[0] = 1.0
        self._waves = np.arange(CODES // 2 + 1)

    def turn(self, angle_rad: float, deviation_rad: float) -> None:
        """It has turned by so much, more or less; or it has been carried anywhere."""
        moved = np.fft.rfft(self._likely) * np.exp(
            -1j * self._waves * angle_rad - 0.5 * (self._waves * deviation_rad) ** 2
        )
        likely = np.maximum(np.fft.irfft(moved, CODES), 0.0)
        self._likely = (1 - LOST) * likely / likely.sum() + LOST / CODES

    def see(self, heading_rad: float, deviation_rad: float) -> None:
        """Vision says so, more or less; or it is wrong altogether."""
        exact = 1.0 / deviation_rad**2
        away = np.exp(exact * (np.cos(self._headings - heading_rad) - 1.0))
        self._likely *= (1 - WRONG) * away / away.sum() + WRONG / CODES
        self._likely /= self._likely.sum()

    @property
    def heading_rad(self) -> float:
        """The mean heading."""
        return float(np.angle(np.sum(self._likely * np.exp(1j * self._headings))))


def follow(
    turned_rad: NDArray[np.floating],
    told_rad: NDArray[np.floating],
    deviations_rad: NDArray[np.floating],
) -> NDArray[np.float64]:
    """The heading after each picture, ``(n,)``; a deviation of infinity: nothing was seen."""
    ring = HeadingFilter()
    found = []
    for turned, told, deviation in zip(turned_rad, told_rad, deviations_rad, strict=True):
        ring.turn(turned, UNCERTAIN_RATE * PICTURE_S)
        if math.isfinite(deviation):
            ring.see(told, deviation)
        found.append(ring.heading_rad)
    return np.array(found)


def drive_row(headings_rad: NDArray[np.floating], off: Floats) -> dict[str, float]:
    """RMS over the drive and of its parts, and the time to be right after the kidnapping."""
    times_s = PICTURE_S * (1 + np.arange(len(off)))
    after = (times_s >= KIDNAPPED_S) & (times_s < DARK_S[0])
    lost = np.flatnonzero(after & (np.abs(off) > TOLD_WITHIN_DEG))
    back_s = PICTURE_S * (lost[-1] + 1) - KIDNAPPED_S + PICTURE_S if len(lost) else 0.0
    return {
        "rms_deg": rms(off),
        "before_deg": rms(off[times_s < KIDNAPPED_S]),
        "back_s": back_s,
        "dark_deg": rms(off[_during(times_s, DARK_S)]),
        "noisy_deg": rms(off[_during(times_s, NOISY_S)]),
    }


def _during(times_s: NDArray[np.floating], span_s: tuple[float, float]) -> NDArray[np.bool_]:
    return (times_s >= span_s[0]) & (times_s < span_s[1])


# ---------------------------------------------------------------------- one seed


def study(seed: int) -> dict[str, list[dict[str, Any]]]:
    """Rows of one room: of views and conditions, of coverages, and of drives."""
    views = {name: (at[:, 2], standardised(small)) for name, (at, small) in seen(seed).items()}
    true_rad, learnt = views["learnt"]
    codes = np.array([code_of(heading) for heading in true_rad])
    causes = Causes(learnt, codes, seed)
    robust = causes.robust()
    kinds = [kind(learnt, codes, seed) for kind in (Pixels, RandomFeatures, SmallCNN)]
    rows: dict[str, list[dict[str, Any]]] = {"views": [], "coverage": [], "drives": []}
    gyroscope = measured_rad(seed, views["drive"][0])
    alone = follow(gyroscope, gyroscope, np.full(len(gyroscope), math.inf))
    drives = {("gyroscope alone", ""): alone}
    for kind in (*kinds, causes, robust):
        of = {name: kind.look(each) for name, (_, each) in views.items() if name != "learnt"}
        if kind is not robust:  # it has the read-out of the other one
            validation = (of["validation"][0], views["validation"][0])
            read = ReadOut(kind.look(learnt)[0], codes, validation)
        told = {name: read.read(features) for name, (features, _) in of.items()}
        off = {name: off_deg(told[name][0], views[name][0]) for name in told}
        doubts = {"bump": {name: bump for name, (_, bump) in told.items()}}
        if of["validation"][1] is not None:
            doubts["view"] = {name: new for name, (_, new) in of.items()}
        limits = {gate: np.quantile(each["validation"], PASSED) for gate, each in doubts.items()}
        if kind is causes:
            limits[SHIPPED], doubts[SHIPPED] = GATE, doubts["view"]
        for gate, most in limits.items():
            doubt = doubts[gate]
            own = {"seed": seed, "method": kind.name, "gate": gate}
            for name in ("validation", *CONDITIONS):
                passed = doubt[name] <= most
                figures = {"rms_deg": rms(off[name]), "passed": float(passed.mean())}
                figures["passed_rms_deg"] = rms(off[name][passed])
                rows["views"].append({**own, "condition": name, **figures})
            if gate == SHIPPED:
                continue
            every = np.concatenate([off[name] for name in CONDITIONS])
            order = np.argsort(np.concatenate([doubt[name] for name in CONDITIONS]))
            for share in COVERAGES:
                kept = every[order[: round(share * len(every))]]
                rows["coverage"].append({**own, "coverage": float(share), "rms_deg": rms(kept)})
            rad_per_doubt = math.radians(rms(off["validation"] / doubt["validation"]))
            deviations = rad_per_doubt * doubt["drive"]
            drives[kind.name, gate] = follow(gyroscope, told["drive"][0], deviations)
    for (name, gate), heading in drives.items():
        figures = drive_row(views["drive"][0], off_deg(heading, views["drive"][0]))
        rows["drives"].append({"seed": seed, "method": name, "gate": gate, **figures})
    return rows


# ---------------------------------------------------------------------- all seeds


def interval(values: Iterable[float]) -> tuple[float, float, float]:
    """Mean over seeds, and its 95 % interval from 2000 resamples of seeds."""
    of = np.array([value for value in values if not math.isnan(value)])
    if not len(of):
        return (math.nan,) * 3
    means = of[np.random.default_rng(1).integers(0, len(of), (2000, len(of)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(of.mean()), float(low), float(high)


def text(values: Iterable[float], digits: int = 1, scale: float = 1.0) -> str:
    """Mean and interval."""
    mean, low, high = (scale * each for each in interval(values))
    return f"{mean:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def chosen(rows: Iterable[Mapping[str, Any]], figure: str, **wanted: Any) -> list[float]:
    """A figure of those rows that have these values."""
    return [float(row[figure]) for row in rows if all(row[k] == v for k, v in wanted.items())]


def table(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Three tables in Markdown: errors, gates, drives."""
    views, drives = rows["views"], rows["drives"]
    methods = list(dict.fromkeys(row["method"] for row in views))
    pairs = list(dict.fromkeys((row["method"], row["gate"]) for row in views))
    lines = [f"| RMS, deg | {' | '.join(methods)} |", "| --- |" + " --- |" * len(methods)]
    for name in CONDITIONS:
        cells = [
            text(chosen(views, "rms_deg", method=method, condition=name, gate="bump"))
            for method in methods
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"| gate | {' | '.join(CONDITIONS)} |", "| --- |" + " --- |" * len(CONDITIONS)]
    for method, gate in pairs:
        cells = []
        for name in CONDITIONS:
            own = {"method": method, "gate": gate, "condition": name}
            passed = interval(chosen(views, "passed", **own))[0]
            left = text(chosen(views, "passed_rms_deg", **own))
            cells.append(f"{100 * passed:.0f} %" + (f": {left}" if passed else ""))
        lines.append(f"| {method}, {gate} | {' | '.join(cells)} |")
    figures = {
        "rms_deg": "161 s, RMS deg",
        "before_deg": "before the kidnapping, deg",
        "back_s": "right after it, s",
        "dark_deg": "occluded, deg",
        "noisy_deg": "noise 100, deg",
    }
    lines += ["", f"| drive, gate | {' | '.join(figures.values())} |"]
    lines += ["| --- |" + " --- |" * len(figures)]
    for method, gate in dict.fromkeys((row["method"], row["gate"]) for row in drives):
        cells = [text(chosen(drives, each, method=method, gate=gate)) for each in figures]
        lines.append(f"| {method}{', ' if gate else ''}{gate} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(rows: Mapping[str, Sequence[Mapping[str, Any]]], file: Path) -> None:
    """Errors by condition, coverage against RMS, and the drives; with intervals over seeds."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(13.0, 4.4), layout="constrained")
    errors, coverage, drives = figure.subplots(1, 3, width_ratios=(1.5, 1.1, 1.0))
    views = rows["views"]
    methods = list(dict.fromkeys(row["method"] for row in views))
    colours = {method: f"C{number}" for number, method in enumerate(methods)}
    for number, method in enumerate(methods):
        points = [
            interval(chosen(views, "rms_deg", method=method, condition=name, gate="bump"))
            for name in CONDITIONS
        ]
        mean, low, high = np.array(points).T
        at = np.arange(len(CONDITIONS)) + 0.13 * (number - 2)
        bars = [mean - low, high - mean]
        errors.errorbar(
            at, mean, bars, fmt="o", ms=4, capsize=2, color=colours[method], label=method
        )
    errors.set_xticks(
        range(len(CONDITIONS)), [n.replace(" ", "\n") for n in CONDITIONS], fontsize=8
    )
    errors.set(yscale="log", ylabel="RMS error (deg)", title="all views")
    errors.legend(fontsize=7)
    styles = {"bump": "--", "view": "-"}
    for method, gate in dict.fromkeys((row["method"], row["gate"]) for row in rows["coverage"]):
        curve = [
            interval(chosen(rows["coverage"], "rms_deg", method=method, gate=gate, coverage=share))
            for share in COVERAGES
        ]
        mean, low, high = np.array(curve).T
        label = f"{method}: {gate}"
        coverage.plot(100 * COVERAGES, mean, styles[gate], color=colours[method], label=label)
        if method in ("pixels", "predictive coding"):
            coverage.fill_between(100 * COVERAGES, low, high, alpha=0.15, color=colours[method])
    coverage.set(yscale="log", xlabel="views that pass (%)", title="the least uncertain views")
    coverage.legend(fontsize=7, loc="upper left")
    pairs = list(dict.fromkeys((row["method"], row["gate"]) for row in rows["drives"]))
    for number, (method, gate) in enumerate(pairs):
        values = chosen(rows["drives"], "rms_deg", method=method, gate=gate)
        mean, low, high = interval(values)
        colour = colours.get(method, "0.5")
        drives.plot(values, np.full(len(values), number), ".", color=colour, alpha=0.4)
        drives.errorbar(
            mean, number, xerr=[[mean - low], [high - mean]], fmt="o", capsize=3, color=colour
        )
    names = [f"{method}: {gate}" if gate else method for method, gate in pairs]
    drives.set_yticks(range(len(pairs)), names, fontsize=8)
    drives.set(xscale="log", xlabel="RMS error of 161 s (deg)", title="drives")
    drives.invert_yaxis()
    for axis in (errors.yaxis, coverage.yaxis, drives.xaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FormatStrFormatter("%g"))
        axis.set_minor_formatter(NullFormatter())
    figure.savefig(file, dpi=100, metadata={"Software": None})


def write(rows: Mapping[str, Sequence[Mapping[str, Any]]], folder: Path) -> None:
    """Write all rows, and the tables."""
    for name, each in rows.items():
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as stream:
            lines = csv.DictWriter(stream, list(each[0]), lineterminator="\n")
            lines.writeheader()
            lines.writerows(each)
    (folder / "table.md").write_text(table(rows), "utf-8")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="rooms: 1 to this one")
    parser.add_argument("--jobs", type=int, default=2, help="rooms at once")
    parser.add_argument("-o", "--output", type=Path, default=Path("build/vision"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes that begin now
    rows: dict[str, list[dict[str, Any]]] = {"views": [], "coverage": [], "drives": []}
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for number, found in enumerate(pool.map(study, range(1, options.seeds + 1)), 1):
            for name, more in found.items():
                rows[name] += more
            write(rows, options.output)
            print(f"room {number} of {options.seeds}", flush=True)
    print(table(rows))
    draw(rows, options.output / "vision_benchmark.png")


if __name__ == "__main__":
    main()
