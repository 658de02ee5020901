"""``neuros bag``: what a run has recorded."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

EXIT_DAMAGED = 4


def add_bag(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    bag = commands.add_parser(
        "bag",
        help="show or complete what a run has recorded",
        description="Show what a run has recorded, or complete the bag of a run that was cut off.",
    )
    actions = bag.add_subparsers(title="actions", metavar="ACTION", required=True)
    info = actions.add_parser("info", help="show the topics of a bag")
    info.add_argument("run", metavar="RUN", help="the run folder, or a bag")
    info.set_defaults(command=_info)
    repair = actions.add_parser(
        "repair",
        help="complete the bag of a run that was killed",
        description="Put the packets that had not reached the bag into it, and complete its files.",
    )
    repair.add_argument("run", metavar="RUN", help="the run folder")
    repair.set_defaults(command=_repair)


def _info(options: argparse.Namespace) -> int:
    from tabulate import tabulate

    from neuros.observe.bag.bag_reader import open_bag

    with open_bag(options.run) as opened:
        rows = [[t.name, t.type, t.count] for t in opened.topics.values()]
        print(tabulate(rows, headers=["topic", "type", "packets"], disable_numparse=True))
        print(f"\n{opened.folder}: {opened.duration_s:.2f} s, project {opened.project or '?'}")
    if opened.damage is None:
        return 0
    print(f"neuros: {opened.damage}", file=sys.stderr)
    return EXIT_DAMAGED


def _repair(options: argparse.Namespace) -> int:
    from neuros.observe.recording.repair import repair

    counts = repair(Path(options.run), lambda text: print(f"neuros: {text}", file=sys.stderr))
    if counts is None:
        print(f"{options.run}: the bag is complete")
    else:
        print(f"{options.run}: completed, {sum(counts.values())} packets on {len(counts)} topics")
    return 0
