"""``neuros verify``: whether two runs carried the same packets."""

from __future__ import annotations

import argparse
from pathlib import Path

EXIT_DIFFERENT, EXIT_UNKNOWN = 1, 2


def add_verify(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    verify = commands.add_parser(
        "verify",
        help="compare the packets of two runs",
        description="Say whether two runs carried the same packets, or where they parted first:"
        " connection, packet, and, where both were recorded, field.",
        epilog="exit codes: 0 identical, 1 different, 2 nothing to compare",
    )
    verify.add_argument("run_a", metavar="RUN_A", type=Path, help="a run folder")
    verify.add_argument("run_b", metavar="RUN_B", type=Path, help="another one")
    verify.set_defaults(command=_verify)


def _verify(options: argparse.Namespace) -> int:
    from neuros.observe.difference import compare
    from neuros.observe.recorded_packets import RecordedPackets
    from neuros.observe.run_record import open_run

    a, b = open_run(options.run_a), open_run(options.run_b)
    recorded = RecordedPackets()
    verdict = compare(a, b, recorded)
    for remark in (*recorded.remarks, *verdict.remarks):
        print(f"note: {remark}")
    if verdict.difference is not None:
        print(f"different: {verdict.difference}")
        return EXIT_DIFFERENT
    if not verdict.compared and verdict.remarks:
        print("unknown: there is nothing to compare")
        return EXIT_UNKNOWN
    print(f"identical: {verdict.compared} packet{'' if verdict.compared == 1 else 's'}")
    return 0
