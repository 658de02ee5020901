"""``neuros replay``: what was recorded, once more: to one node, or on the ROS graph."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.errors import UsageError

if TYPE_CHECKING:
    from neuros.observe.bag.bag_reader import RecordedTopic


def add_replay(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    replay = commands.add_parser(
        "replay",
        help="run one node of a run once more, or publish recorded topics",
        description="With --node: run one node once more on exactly what it received, and compare"
        " what it sends, packet by packet. With --topic: publish recorded topics on the ROS graph,"
        " spaced as they were sent.",
        epilog="exit codes of --node: 0 identical, 1 different, 2 nothing to compare,"
        " 4 the node needs what this machine does not have",
    )
    add = replay.add_argument
    add("run", metavar="RUN", help="the run folder, or a bag")
    add("-n", "--node", metavar="NAME", help="the node to run once more")
    debugger = replay.add_mutually_exclusive_group()
    debugger.add_argument(
        "--pdb",
        "--debug",
        action="store_true",
        help="with --node: under Python's debugger, which stops at the start of each hook, and"
        " after a failure",
    )
    debugger.add_argument(
        "--debugpy",
        type=int,
        metavar="PORT",
        help="with --node: wait until an editor's debugger attaches there (pip install debugpy)",
    )
    add(
        "-o",
        "--output",
        metavar="FOLDER",
        help="with --node: keep what the node writes to node.run_dir (default: it is removed)",
    )
    add(
        "-t",
        "--topic",
        action="append",
        default=[],
        dest="replay_topics",
        metavar="NAME",
        help="a topic, an output (node.output) or a connection (repeatable); * stands for any",
    )
    add("--rate", type=float, default=1.0, metavar="FACTOR", help="times as fast (default: 1)")
    add(
        "--delay",
        type=float,
        default=1.0,
        metavar="SECONDS",
        help="before the first packet, so that subscribers find the topics (default: 1)",
    )
    add(
        "-w",
        "--wait-matching-subscriptions",
        type=int,
        default=0,
        metavar="N",
        help="begin when each topic has that many, as `ros2 topic pub` does (default: 0)",
    )
    add("-d", "--domain-id", type=int, metavar="ID", help="default: ROS_DOMAIN_ID, else 0")
    replay.set_defaults(command=_replay)
    _add_replayed(commands)


def _add_replayed(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """What ``replay --node`` becomes; it is not started by people."""
    replayed = commands.add_parser("replayed", add_help=False)
    replayed.add_argument("node_file")
    replayed.add_argument("--run", required=True)
    replayed.add_argument("--pdb", action="store_true")
    replayed.add_argument("--debugpy", type=int)
    replayed.add_argument("--remove", action="store_true")
    replayed.set_defaults(command=_run_replayed)


def _run_replayed(options: argparse.Namespace) -> int:
    from neuros.cli.replay_node import run_replayed

    return run_replayed(options)


def _replay(options: argparse.Namespace) -> int:
    if options.node is not None:
        return _replay_node(options)
    if options.pdb or options.debugpy is not None or options.output is not None:
        raise UsageError("replay: --pdb, --debugpy and --output are for a node: name it, --node")
    if not options.replay_topics:
        raise UsageError(
            "replay: name a node to run once more (--node NAME), or what to publish (--topic NAME,"
            " or --topic '*' for all)"
        )
    if not options.rate > 0 or options.delay < 0 or options.wait_matching_subscriptions < 0:
        raise UsageError("replay: --rate must be above 0, --delay and -w not below")
    from neuros.cli.messages import find_messages_of
    from neuros.observe.bag.bag_reader import open_bag
    from neuros.transport.playing import PlayedTopic, play

    find_messages_of(Path(options.run))
    with open_bag(options.run) as bag:
        if bag.damage is not None:
            print(f"neuros: {bag.damage}", file=sys.stderr)
        chosen = _chosen([*bag.topics.values()], options.replay_topics)
        packets = sorted(
            (packet.log_time_ns, topic.name, packet.data)
            for topic in chosen
            for packet in topic.raw()
        )
        count = play(
            {t.name: PlayedTopic(t.type, t.is_reliable, t.depth, t.is_latched) for t in chosen},
            packets,
            rate=options.rate,
            delay_s=options.delay,
            subscriptions=options.wait_matching_subscriptions,
            domain_id=options.domain_id,
        )
    print(f"{count} packets on {len(chosen)} topics")
    return 0


def _replay_node(options: argparse.Namespace) -> int:
    if options.replay_topics:
        raise UsageError("replay: --node runs a node, --topic publishes: choose one of them")
    from neuros.cli.replay_node import replay_node

    return replay_node(options)


def _chosen(topics: Sequence[RecordedTopic], patterns: Sequence[str]) -> list[RecordedTopic]:
    """The topics that are asked for. Raises ``UsageError`` if a pattern fits none."""
    from neuros.observe.recording.selection import is_named

    for pattern in patterns:
        if not any(is_named(t.name, t.connection, [pattern]) for t in topics):
            there = ", ".join(t.connection or t.name for t in topics)
            raise UsageError(f"--topic {pattern}: the bag has no such topic; it has {there}")
    return [t for t in topics if is_named(t.name, t.connection, patterns)]
