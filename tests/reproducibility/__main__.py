"""Runs, over and over: ``python -m tests.reproducibility --runs 100 --table FILE``.

Runs each strict example on each back end under changing load; with ``--time virtual``, those that
lose packets, tick, or have physics that runs by itself, in virtual time. The exit code is 1 if an
example had packets of more than one digest, or a run failed. Run it with another Python for that
one's rows.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.load.running import busy_processes
from tests.support.tables import update_rows

from .running import BACKENDS, STRICT, VIRTUAL, Repeated, changing_load, differing, repeat

_HEAD = "| example | back end | Python | runs | packets in each | digests |"


def main() -> int:
    """Run; returns the exit code."""
    options = _options()
    found: list[Repeated] = []
    load = changing_load(options.seed) if options.busy is None else busy_processes(options.busy)
    with load:
        for project in options.project or (VIRTUAL if options.time == "virtual" else STRICT):
            for backend in options.backend or BACKENDS:
                with tempfile.TemporaryDirectory(prefix="neuros-reproducibility-") as name:
                    repeated = repeat(project, backend, options.runs, Path(name))
                found.append(repeated)
                print(_row(repeated), *repeated.problems, sep="\n", flush=True)
                if options.table:
                    update_rows(options.table, _HEAD, _row(repeated), 3)
    parted = differing(found)
    for project in parted:
        print(f"{project}: not the same packets in every run")
    return 1 if parted or any(each.problems for each in found) else 0


def _row(repeated: Repeated) -> str:
    digests = ", ".join(f"`{each}`" for each in sorted(repeated.digests)) or "none"
    failed = f", **{len(repeated.problems)} failed**" if repeated.problems else ""
    return (
        f"| `{repeated.project}` | {repeated.backend} | {repeated.python}"
        f" | {repeated.digests.total()}{failed} | {repeated.packets} | {digests} |"
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.reproducibility", description=__doc__)
    parser.add_argument("--runs", type=int, default=10, help="so many of each (10)")
    parser.add_argument("--backend", action="append", choices=BACKENDS, help="repeatable")
    parser.add_argument(
        "--project", action="append", choices=(*STRICT, *VIRTUAL), help="repeatable"
    )
    parser.add_argument("--time", choices=("real", "virtual"), default="real", help="(real)")
    parser.add_argument("--busy", type=int, metavar="N", help="busy processes (0 to 3, changing)")
    parser.add_argument("--seed", type=int, default=1, help="of the load (1)")
    parser.add_argument("--table", type=Path, metavar="FILE", help="put the rows into its table")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
