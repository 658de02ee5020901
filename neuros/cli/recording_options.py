"""The options of a recording, and the hidden command of its recorder."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from neuros.errors import UsageError

if TYPE_CHECKING:
    from neuros.observe.recording.selection import Request


def add_recording_options(launch: argparse.ArgumentParser) -> None:
    """Add what ``launch`` has to be told about a recording."""
    group = launch.add_argument_group(
        "recording", "NAME is a topic, an output (node.output), or a connection; * stands for any"
    )
    group.add_argument(
        "-r",
        "--record",
        action="store_true",
        help="record everything into RUN/bag: every connection, the external topics, and /clock;"
        " with -t, those besides",
    )
    group.add_argument(
        "-t",
        "--topic",
        action="append",
        default=[],
        dest="record_topics",
        metavar="NAME",
        help="record this, be it a ROS topic that no node has (repeatable); alone: only this;"
        " with -r: everything, and this",
    )
    group.add_argument(
        "--exclude",
        action="append",
        default=[],
        metavar="NAME",
        help="do not record this (repeatable)",
    )
    group.add_argument(
        "--storage",
        choices=("mcap", "sqlite3"),
        default="mcap",
        help="the format of the bag's file (default: mcap)",
    )


def recording_request(options: argparse.Namespace) -> Request | None:
    """What the command line has recorded, ``None``: nothing. Raises ``UsageError``."""
    from neuros.observe.recording.selection import Request

    if options.record or options.record_topics:
        return Request(
            everything=options.record,
            topics=tuple(options.record_topics),
            exclude=tuple(options.exclude),
            storage=options.storage,
        )
    if options.exclude or options.storage != "mcap":
        name = "--exclude" if options.exclude else "--storage"
        raise UsageError(f"{name}: nothing is recorded; add -r, or name topics with -t")
    return None


def add_recorder(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """What ``launch`` starts; people do not."""
    recorder = commands.add_parser("recorder", add_help=False)
    recorder.add_argument("run")
    recorder.set_defaults(command=_run_recorder)


def _run_recorder(options: argparse.Namespace) -> int:
    from neuros.cli.recorder import run_recorder

    return run_recorder(options)
