"""``neuros timing``; ``--help`` and completion read this module, too."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.cli.common import JSON, add_format, print_json
from neuros.errors import UsageError
from neuros.ordinary_files import write_whole
from neuros_analysis.command import writing
from neuros_analysis.options import FITS

if TYPE_CHECKING:
    from neuros.api.packets import Numbers
    from neuros_analysis.timing import Timing

_PICTURES = (".png", ".svg", ".pdf")
_Rows = list[dict[str, Any]]
_Panels = dict[str, dict[str, "Numbers"]]
"""Seconds by title of a panel, and by label of a curve."""


def add_timing(timing: argparse.ArgumentParser) -> None:
    timing.description = (
        "Measure how long the hooks of a run took, and how long packets were under way on each"
        " connection. With -o, write a file for `neuros launch --timing`. With a second run,"
        " compare the distributions of both. For a run that was started in parts, name a folder"
        " that holds the run folders of all parts."
    )
    timing.add_argument("run", metavar="RUN", type=Path, help="a run folder")
    timing.add_argument(
        "other", metavar="RUN_B", nargs="?", type=Path, help="a run to compare with the first one"
    )
    timing.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write the timing of the run (JSON)"
    )
    timing.add_argument(
        "--as",
        dest="fit",
        choices=FITS,
        help="write this of each hook and connection: samples (at most 1000, which keep the"
        " distribution), a fitted lognormal or normal distribution, or the mean as a constant"
        " (default: samples)",
    )
    timing.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help=f"draw the distributions ({', '.join(_PICTURES)}): measured beside fitted, or those of"
        " both runs",
    )
    add_format(timing)
    timing.set_defaults(command=_timing)


def _timing(options: argparse.Namespace) -> int:
    from neuros_analysis.timing import measure

    if options.other is not None and (options.output is not None or options.fit is not None):
        raise UsageError("-o and --as need one run, and two are named: leave the second one out")
    if options.plot is not None and options.plot.suffix not in _PICTURES:
        raise UsageError(f"--plot {options.plot}: its name must end in {', '.join(_PICTURES)}")
    runs = [each for each in (options.run, options.other) if each is not None]
    timings = [measure(folder) for folder in runs]
    fit = options.fit or FITS[0]
    rows, panels = _fitted(timings[0], fit) if len(runs) == 1 else _compared(runs, timings)
    files: dict[Path, bytes] = {}
    if options.output is not None:
        files[options.output] = timings[0].file(fit).encode()
    if options.plot is not None:
        from neuros_analysis.charts import distributions_figure
        from neuros_analysis.run_pages import picture

        files[options.plot] = picture(distributions_figure(panels), options.plot.suffix[1:])
    if options.format == JSON:
        missing = [dict(timing.missing) for timing in timings]
        print_json({"runs": [str(folder) for folder in runs], "rows": rows, "missing": missing})
    else:
        from neuros_analysis.comparison import comparison_table

        cells = [
            [f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()]
            for row in rows
        ]
        print(comparison_table(["", *[*rows[0]][1:]] if rows else [""], cells))
        for folder, timing in zip(runs, timings, strict=True):
            for name, why in timing.missing.items():
                print(f"missing{f' in {folder}' if len(runs) > 1 else ''}: {name}: {why}")
    for file, data in files.items():
        with writing(file.parent):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, data)
        if options.format != JSON:
            print(file)
    return 0


def _fitted(timing: Timing, fit: str) -> tuple[_Rows, _Panels]:
    """A row and a panel for each hook and connection: what was measured, and the fit."""
    from neuros_analysis.timing import distance, drawn_s

    rows: _Rows = []
    panels = {}
    for name, each in timing.all.items():
        row = {"name": name, "of": each.of, "count": len(each.values_s), **_figures(each.values_s)}
        fitted_s = drawn_s(each.fit(fit))
        if fit != FITS[0]:
            row |= {fit: str(each.fit(fit).keys), "distance": distance(each.values_s, fitted_s)}
        rows.append(row)
        panels[name] = {"measured": each.values_s, fit: fitted_s}
    return rows, panels


def _compared(runs: Sequence[Path], timings: Sequence[Timing]) -> tuple[_Rows, _Panels]:
    """A row and a panel for each duration, delay and latency of both runs."""
    from neuros_analysis.timing import by_chance, distance

    names = [folder.resolve().name for folder in runs]
    labels = (
        names
        if len({*names}) == len(names)
        else [f"{n}: {f}" for n, f in zip("AB", runs, strict=True)]
    )
    one, other = (
        {
            **{name: each.values_s for name, each in timing.all.items()},
            **{f"{name}: latency": each for name, each in timing.latencies_s.items()},
        }
        for timing in timings
    )
    rows: _Rows = []
    panels = {}
    for name in (name for name in one if name in other):
        both = one[name], other[name]
        if not all(map(len, both)):
            continue
        row: dict[str, Any] = {"name": name}
        for label, values_s in zip("AB", both, strict=True):
            figures = {"count": len(values_s), **_figures(values_s)}
            row |= {f"{key} {label}": value for key, value in figures.items()}
        row |= {"distance": distance(*both), "by chance": by_chance(*map(len, both))}
        rows.append(row)
        panels[name] = dict(zip(labels, both, strict=True))
    return rows, panels


def _figures(values_s: Numbers) -> dict[str, float]:
    import numpy as np

    median, most = np.percentile(values_s, (50, 99)) * 1e3
    return {"median / ms": float(median), "99 % / ms": float(most)}
