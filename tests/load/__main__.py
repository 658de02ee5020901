"""Lossless packets by the million: ``python -m tests.load --packets 1000000 --table docs/load.md``.

Runs each shape on each back end, beside busy processes. The exit code is 1 if a packet was lost or
changed, or latency or memory grew.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.support.tables import update_rows

from .running import BACKENDS, Load, latency_problems, run
from .shapes import LARGEST_BYTES, SHAPES

_HEAD = (
    "| shape | back end | lossless packets | time | latency, first tenth | last tenth | p99"
    " | memory, first tenth | last tenth |"
)


def main() -> int:
    """Run; returns the exit code."""
    options = _options()
    failed = 0
    for backend in options.backend or BACKENDS:
        for shape in options.shape or SHAPES:
            with tempfile.TemporaryDirectory(prefix="neuros-load-") as name:
                load = run(
                    *(shape, backend, options.packets, Path(name)),
                    largest=options.largest,
                    busy=options.busy,
                )
            load.problems += latency_problems(load.latency_ms)
            failed += bool(load.problems)
            print(_row(load), flush=True)
            if options.table:
                update_rows(options.table, _HEAD, _row(load), 2)
    return 1 if failed else 0


def _row(load: Load) -> str:
    first_ms, last_ms, p99_ms = load.latency_ms
    memory = [f"{mb:.0f} MB" if mb else "-" for mb in load.memory_mb]  # none of a short run
    row = (
        f"| {load.shape} | {load.backend} | {load.lossless:,} | {load.seconds:.0f} s"
        f" | {first_ms:.2f} ms | {last_ms:.2f} ms | {p99_ms:.1f} ms"
        f" | {' | '.join(memory)} |"
    )
    return f"{row[:-1]}**{'; '.join(load.problems)}** |" if load.problems else row


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.load", description=__doc__)
    parser.add_argument("--packets", type=int, default=1_000_000, help="in each run (10^6)")
    parser.add_argument("--backend", action="append", choices=BACKENDS, help="repeatable")
    parser.add_argument("--shape", action="append", choices=tuple(SHAPES), help="repeatable")
    parser.add_argument(
        "--largest", type=int, default=LARGEST_BYTES, metavar="BYTES", help="(8 MB)"
    )
    parser.add_argument("--busy", type=int, default=2, help="so many busy processes beside it (2)")
    parser.add_argument("--table", type=Path, metavar="FILE", help="put the rows into its table")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
