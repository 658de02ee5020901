"""A lossless stream over bad networks: ``python -m tests.integration.network --table FILE``.

Two machines are network namespaces (root). The exit code is 1 if a packet did not arrive.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

_HERE = Path(__file__).resolve().parent
sys.path[:0] = map(str, (_HERE, _HERE.parents[1], _HERE.parents[1] / "support"))  # as pytest has

from cable import Cable  # noqa: E402
from conditions import CONDITIONS, Stream, stream  # noqa: E402
from two_machines import two_machines  # noqa: E402

from tests.support.tables import update_rows  # noqa: E402

_IMAGE_BYTES = 1 << 16
_HEAD = "| cable | bytes | arrived | took | median | p95 | max. |"


def main() -> int:
    """Stream under each condition; returns the exit code."""
    options = _options()
    cable, failed = Cable(), 0
    with two_machines(cable) as machines:
        for name in options.condition or CONDITIONS:
            for size, count in ((0, options.count), (_IMAGE_BYTES, max(1, options.count // 10))):
                with tempfile.TemporaryDirectory(prefix="neuros-network-") as folder:
                    found = stream(
                        *(machines, cable, CONDITIONS[name], Path(folder)), count=count, size=size
                    )
                failed += bool(found.problems)
                row = _row(name, size, count, found)
                print(row, *found.problems, sep="\n", flush=True)
                if options.table:
                    update_rows(options.table, _HEAD, row, 2)
    return 1 if failed else 0


def _row(name: str, size: int, count: int, found: Stream) -> str:
    arrived = f"{len(found.arrived)} of {count}"
    return (
        f"| {name} | {size:,} | {f'**{arrived}**' if found.problems else arrived}"
        f" | {found.took_s:.1f} s | {found.median_ms:.1f} ms | {found.age_ms(0.95):.0f} ms"
        f" | {found.age_ms(1.0):.0f} ms |"
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.integration.network", description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="packets; a tenth as images (300)")
    parser.add_argument("--condition", action="append", choices=tuple(CONDITIONS))
    parser.add_argument("--table", type=Path, metavar="FILE", help="put the rows into its table")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
