"""``python -m benchmarks [--quick] [PART ...]``: measure, print a table, keep all single values."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

from tabulate import tabulate

from benchmarks import engine, round_trip, whiskeye
from benchmarks.measure import HEADERS, Row, load_before, machine

PARTS = {"engine": engine.measure, "round_trip": round_trip.measure, "whiskeye": whiskeye.measure}
RESULTS = Path(__file__).resolve().parents[1] / "build" / "benchmarks"


def say(line: str) -> None:
    """Progress."""
    print(line, file=sys.stderr, flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (all)")
    parser.add_argument("--quick", action="store_true", help="few and short rounds")
    options = parser.parse_args()
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    rows: list[Row] = []
    loads: dict[str, float] = {}
    for name in options.parts or PARTS:
        loads[name] = load_before()
        say(f"{name} (others keep {loads[name]:.0%} of the cores busy)")
        rows += PARTS[name](options.quick, say)
    result = {
        "machine": machine(),
        "quick": options.quick,
        "load_before": loads,
        "load_average": os.getloadavg(),
        "rows": [row.as_json() for row in rows],
    }
    print(tabulate([row.as_cells() for row in rows], headers=HEADERS))
    RESULTS.mkdir(parents=True, exist_ok=True)
    file = RESULTS / time.strftime("%Y-%m-%dT%H-%M-%SZ.json", time.gmtime())
    file.write_text(json.dumps(result, indent=2) + "\n")
    print(f"\n{result['machine']}\nbusy with other things before: {loads}\nall values: {file}")


if __name__ == "__main__":
    main()
