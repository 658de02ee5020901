"""Options of ``neuros sweep``, which are arguments of ``neuros.sweep``, too; fits of timing."""

from __future__ import annotations

import os
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from neuros.api.request import Request
from neuros.options import like, option, positive_number
from neuros.registry import EXECUTORS

if TYPE_CHECKING:
    from concurrent.futures import Executor

FITS = ("samples", "lognormal", "normal", "constant")
"""What a file of ``neuros timing`` has of each hook and connection."""

OnRow: TypeAlias = "Callable[[int, int, Mapping[str, Any]], None]"


def _seeds(text: str) -> tuple[int, ...]:
    try:
        ends = [[int(end) for end in part.split("..", 1)] for part in text.split(",")]
    except ValueError:
        raise ArgumentTypeError(f"'{text}': give whole numbers, as in 1,2,3 or 1..8") from None
    if any(each[-1] < each[0] for each in ends):
        raise ArgumentTypeError(f"'{text}': give the smaller number of a range first, as in 1..8")
    return tuple(seed for each in ends for seed in range(each[0], each[-1] + 1))


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Options of ``neuros sweep``, which are arguments of :func:`sweep`."""

    set: Mapping[str, Any] | Sequence[str] | None = option(
        "--set",
        is_repeatable=True,
        metavar="PATH=VALUE,...",
        help="set a key of the project, as launch does, to each of these values; commas separate"
        " them, but not within brackets or quotes",
    )
    points: Sequence[Mapping[str, Any]] = option(
        default=(),
        help="values by path for each run, beside those of set and in place of all combinations:"
        " the runs that an optimiser asks for",
    )
    seeds: Iterable[int] = option(
        "--seeds",
        parse=_seeds,
        default=(),
        metavar="SEED,...",
        default_help="as in the files",
        help="run with each of these seeds: every environment variable of a node with SEED in its"
        " name gets the seed; 1..8 are the seeds 1 to 8",
    )
    repeat: int = option(
        "--repeat", parse=positive_number, default=1, metavar="N", help="runs of each combination"
    )
    executor: str | Executor = option(
        "--executor",
        default="local",
        suggestions=lambda: EXECUTORS,
        metavar="NAME",
        page="../extensions/neuros-analysis/README.md#sweeps-on-a-cluster",
        help="where the runs are made: local (this machine), slurm or slurm=PARTITION (an array"
        " of Slurm jobs), dask=ADDRESS (Dask workers), dask (Dask workers on this machine); other"
        " Python packages may add executors, and Python programs may pass any executor of"
        " concurrent.futures",
    )
    jobs: int | None = option(
        "--jobs",
        parse=positive_number,
        metavar="N",
        default_help="1 with local, else as many as there is room for",
        help="number of runs at the same time; they share the processors, so their real-time"
        " factors mean little",
    )
    retry: bool = option(
        "--retry", default=False, help="repeat the runs that failed in an earlier call"
    )
    backend: str | None = like(Request, "backend")
    duration: float | str | None = like(Request, "duration")
    portable: bool | None = like(Request, "portable")
    record: bool | Sequence[str] = like(Request, "record", group="")
    restore: Mapping[str, Any] | Sequence[str] = like(Request, "restore", group="")
    output: str | os.PathLike[str] | None = option(
        "-o",
        "--output",
        metavar="DIR",
        default_help="runs/<project>/sweep-<utc time>",
        help="write into this folder: a new one, or that of an earlier call, to continue its sweep",
    )
    on_row: OnRow | None = option(
        help="called with the number of a run, of how many, and its row", is_recorded=False
    )
