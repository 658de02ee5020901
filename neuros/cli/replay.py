"""``neuros replay``: what was recorded, once more."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from neuros.errors import UsageError

if TYPE_CHECKING:
    from neuros.observe.bag.opened import RecordedTopic


def add_replay(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    replay = commands.add_parser(
        "replay",
        help="publish recorded topics on the ROS graph",
        description="Publish recorded topics on the ROS graph, spaced as they were sent.",
    )
    add = replay.add_argument
    add("run", metavar="RUN", help="the run folder, or a bag")
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
    add("-d", "--domain-id", type=int, metavar="ID", help="default: ROS_DOMAIN_ID, else 0")
    replay.set_defaults(command=_replay)


def _replay(options: argparse.Namespace) -> int:
    if not options.replay_topics:
        raise UsageError("replay: name what to publish with --topic NAME, or --topic '*' for all")
    if not options.rate > 0 or options.delay < 0:
        raise UsageError("replay: --rate must be above 0, and --delay not below")
    from neuros.observe.bag.opened import open_bag
    from neuros.transport.playing import PlayedTopic, play

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
            {t.name: PlayedTopic(t.type, t.is_reliable, t.depth) for t in chosen},
            packets,
            rate=options.rate,
            delay_s=options.delay,
            domain_id=options.domain_id,
        )
    print(f"{count} packets on {len(chosen)} topics")
    return 0


def _chosen(topics: Sequence[RecordedTopic], patterns: Sequence[str]) -> list[RecordedTopic]:
    """The topics that are asked for. Raises ``UsageError`` if a pattern fits none."""
    from neuros.observe.recording.selection import is_named

    for pattern in patterns:
        if not any(is_named(t.name, t.connection, [pattern]) for t in topics):
            there = ", ".join(t.connection or t.name for t in topics)
            raise UsageError(f"--topic {pattern}: the bag has no such topic; it has {there}")
    return [t for t in topics if is_named(t.name, t.connection, patterns)]
