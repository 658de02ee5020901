"""Commands about runs that are over: ``verify`` and ``bag``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from neuros.cli.common import JSON, add_format, print_json
from neuros.errors import UsageError
from neuros.project.suggest import counted
from neuros.registry import NAMES

EXIT_DIFFERENT = 1
EXIT_UNKNOWN = 2
EXIT_DAMAGED = 4
EXIT_LEFT_OUT = 4
EXIT_CONSUMED = 6


def add_verify(verify: argparse.ArgumentParser) -> None:
    verify.description = (
        "Say whether two runs carried the same packets. If not, name the first difference:"
        " connection, packet and, if both runs were recorded, field. For a run that was started"
        " in parts, name a folder that holds the run folders of all parts. Of a file of"
        " `neuros pack`: run the project again as it was, and compare it with the packed run. That"
        " executes what is in the file."
    )
    verify.epilog = (
        "exit codes: 0 identical, 1 different, 2 nothing to compare, 6 the same packets were sent,"
        " but hooks took others of them"
    )
    verify.add_argument(
        "run_a", metavar="RUN_A", type=Path, help="a run folder, or a file of `neuros pack`"
    )
    verify.add_argument("run_b", metavar="RUN_B", type=Path, nargs="?", help="another run folder")
    add_format(verify)
    verify.set_defaults(command=_verify)


def _verify(options: argparse.Namespace) -> int:
    if options.run_b is not None:
        return _compare(options.run_a, options.run_b, options.format)
    if not options.run_a.is_file():
        raise UsageError(
            f"verify {options.run_a}: name another run folder after it, or a file of `neuros pack`"
        )
    with TemporaryDirectory(prefix="neuros-verify-") as folder:
        packed, again = NAMES.load("packs").run_again(options.run_a, Path(folder))
        return _compare(packed, again, options.format)


def _compare(run_a: Path, run_b: Path, form: str) -> int:
    from neuros.api.run_record import open_whole
    from neuros.api.verify import RecordedPackets, compare

    a, b = open_whole(run_a), open_whole(run_b)
    recorded = RecordedPackets()
    verdict = compare(a, b, recorded)
    remarks = [*recorded.remarks, *verdict.remarks]
    packets = counted(verdict.compared, "packet")
    result, exit_code, what = "identical", 0, packets
    if verdict.difference is not None:
        result, exit_code, what = "different", EXIT_DIFFERENT, verdict.difference
    elif not verdict.compared and verdict.remarks:
        result, exit_code, what = "unknown", EXIT_UNKNOWN, "there is nothing to compare"
    elif taken := verdict.consumed_differently:
        result, exit_code = "sent packets identical", EXIT_CONSUMED
        what = f"{packets}; {_were(taken)} consumed differently"
    if verdict.not_compared and exit_code in (0, EXIT_CONSUMED):
        what += f"; {_were(verdict.not_compared)} not compared, or not whole"
    if form == JSON:
        print_json(
            {
                "verdict": result,
                "packets": verdict.compared,
                "difference": verdict.difference,
                "consumed_differently": verdict.consumed_differently,
                "not_compared": verdict.not_compared,
                "likely_cause": verdict.likely_cause,
                "notes": remarks,
            }
        )
        return exit_code
    for remark in remarks:
        print(f"note: {remark}")
    if verdict.likely_cause:
        print(f"likely cause: {verdict.likely_cause}")
    print(f"{result}: {what}")
    return exit_code


def _were(connections: Sequence[str]) -> str:
    verb = "was" if len(connections) == 1 else "were"
    return f"{counted(len(connections), 'connection')} {verb}"


_A_BAG = "the run folder, or a bag: a folder, .mcap or .db3, compressed or not"


def add_bag(bag: argparse.ArgumentParser) -> None:
    bag.description = (
        "Show what a bag has, of a run or of another program; convert it; or complete the bag of a"
        " run that was cut off."
    )
    actions = bag.add_subparsers(title="actions", metavar="ACTION", required=True)
    info = actions.add_parser("info", help="show the topics of a bag")
    info.add_argument("run", metavar="RUN", help=_A_BAG)
    info.set_defaults(command=_info)
    convert = actions.add_parser(
        "convert",
        help="write a bag anew, as MCAP with all definitions of messages",
        description="Write a bag of any storage and compression anew, as one MCAP file with the"
        " definitions of its messages, which every program can read.",
    )
    convert.add_argument("run", metavar="BAG", help=_A_BAG)
    convert.add_argument("-o", "--output", required=True, metavar="FOLDER", help="a new folder")
    convert.add_argument(
        "-t",
        "--topic",
        action="append",
        default=[],
        dest="topics",
        metavar="NAME",
        help="this topic, output (node.output) or connection only (repeatable); * stands for any"
        " characters",
    )
    convert.set_defaults(command=_convert)
    repair = actions.add_parser(
        "repair",
        help="complete the bag of a run that was killed",
        description="Add the packets that had not reached the bag, and complete its files.",
    )
    repair.add_argument("run", metavar="RUN", help="the run folder")
    repair.add_argument(
        "--keep-changed",
        action="store_true",
        help="keep packets that may have changed, since a checksum is wrong",
    )
    repair.set_defaults(command=_repair)


def _info(options: argparse.Namespace) -> int:
    from tabulate import tabulate

    from neuros.bag import open_bag

    with open_bag(options.run) as opened:
        rows = [[t.name, t.type, t.count] for t in opened.topics.values()]
        print(tabulate(rows, headers=["topic", "type", "packets"], disable_numparse=True))
        about = [f"{opened.duration_s:.2f} s"]
        about += [f"project {opened.project}"] if opened.project else []
        about += [f"ROS {opened.distribution.capitalize()}"] if opened.distribution else []
        print(f"\n{opened.folder}: {', '.join(about)}")
        for note in (*opened.notes, *opened.undecodable().values()):
            print(f"note: {note}")
        damage = opened.check()
    if damage is None:
        return 0
    print(f"neuros: {damage}", file=sys.stderr)
    return EXIT_DAMAGED


def _convert(options: argparse.Namespace) -> int:
    from neuros.bag import open_bag
    from neuros.cli.environments import find_messages_of

    find_messages_of(Path(options.run))
    output = Path(options.output)
    if output.exists():
        raise UsageError(f"bag convert: {output} exists: name a new folder")
    with open_bag(options.run) as opened:
        chosen = opened.chosen(options.topics or ["*"])
        left_out = opened.undecodable()
        names = [topic.name for topic in chosen if topic.name not in left_out]
        count = opened.convert(output, names) if names else 0
        for name in (topic.name for topic in chosen if topic.name in left_out):
            print(f"neuros: left out: {left_out[name]}", file=sys.stderr)
    if names:
        print(f"{output}: {counted(count, 'packet')} on {counted(len(names), 'topic')}")
    return EXIT_LEFT_OUT if len(names) < len(chosen) else 0


def _repair(options: argparse.Namespace) -> int:
    from neuros.recording.recorder import KEPT_NAME, named, repair

    def complain(text: str) -> None:
        print(f"neuros: {text}", file=sys.stderr)

    repaired = repair(Path(options.run), complain, keeps_changed=options.keep_changed)
    if repaired is None:
        print(f"{options.run}: the bag is complete")
        return 0
    counts = repaired.counts
    print(f"{options.run}: completed, {sum(counts.values())} packets on {len(counts)} topics")
    if repaired.changed:
        what = "kept" if options.keep_changed else f"left out: {KEPT_NAME} has them"
        complain(f"{repaired.changed} packets, any of which may have changed, are {what}")
    if repaired.lost:
        complain(f"packets that were recorded, and are not in the bag: {named(repaired.lost)}")
    return EXIT_DAMAGED if repaired.changed or repaired.lost else 0
