"""Options of ``neuros launch``, and those that every command about a project has."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from neuros.cli.dashboard import add_dashboard_options
from neuros.cli.views import add_view_options
from neuros.errors import NeurosError

EXIT_CODES = """\
exit codes:
  0    ended normally
  1    a node failed or had to be killed, a deadlock, or a lossless connection lost a packet
  2    wrong usage
  3    invalid project: every problem is listed with its file and line
  4    something is missing on this machine, or a record could not be written
  5    the run broke a budget of its project
  130  ended by Ctrl+C (a second one kills at once)
  143  ended by SIGTERM, or because the terminal was closed
"""


def add_launch(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], arguments: Sequence[str]
) -> None:
    """Add the command to the grammar, with the options of the back end in ``arguments``."""
    launch = commands.add_parser(
        "launch",
        help="run a project",
        description="Run a project: start its nodes, connect them, and stay until all have ended.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_project(launch)
    launch.add_argument(
        "-n",
        "--node",
        action="append",
        default=[],
        metavar="NAME",
        help="start only this node (repeatable); the others may run elsewhere",
    )
    launch.add_argument(
        "-d",
        "--domain-id",
        type=int,
        metavar="ID",
        help="ROS domain (default: ROS_DOMAIN_ID; else 0 where the project has external topics"
        ", or -n or --network is used; else the first free one of 1 to 101)",
    )
    _add_network(launch)
    launch.add_argument(
        "--backend",
        default=os.environ.get("NEUROS_BACKEND") or "auto",
        metavar="NAME",
        help="where nodes run: the name of a back end, below, as process; each may have options of"
        " its own (default: NEUROS_BACKEND, else auto: docker where an engine has the images, and"
        " else process)",
    )
    launch.add_argument(
        "--duration",
        metavar="SECONDS",
        help="end after this time from the first hook on, drained: 30, or 30sim in simulated time",
    )
    launch.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        help="the run folder; new or empty (default: runs/<project>/<utc time>)",
    )
    launch.add_argument(
        "--no-placement",
        action="store_true",
        help="ignore affinity: the kernel chooses the cores of every node",
    )
    _add_observation(launch)
    add_dashboard_options(launch)
    add_view_options(launch)
    _add_recording_options(launch)
    launch.add_argument(
        "--progress",
        action=argparse.BooleanOptionalAction,
        help="show how far the run has come: a line that stays, or, where standard output is no"
        " terminal, a line every 10 s (default: if it is known when the run ends)",
    )
    launch.add_argument("--dry-run", action="store_true", help="print what would be started")
    launch.add_argument("-v", "--verbose", action="store_true", help="show DEBUG records, too")
    if arguments[:1] == ["launch"]:
        _add_back_ends(launch, arguments)
    launch.set_defaults(command=launch_project)


def _add_back_ends(launch: argparse.ArgumentParser, arguments: Sequence[str]) -> None:
    """Add what the back end that the command line names lets one choose; for help, of all."""
    from neuros.backends.registered import AUTO, BACK_ENDS
    from neuros.options import add_options

    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--backend", nargs="?")
    first.add_argument("-h", "--help", action="store_true")
    asked, _ = first.parse_known_args(arguments)
    named = asked.backend or os.environ.get("NEUROS_BACKEND") or AUTO
    for name in BACK_ENDS if asked.help else {named} - {AUTO}:
        try:
            back_end = BACK_ENDS.load(name)
        except NeurosError as error:
            if not asked.help:
                raise
            launch.add_argument_group(f"back end {name}", str(error))
            continue
        group = launch.add_argument_group(f"back end {name}", f"each node in {back_end.place}")
        add_options(group, [replace(each, group="") for each in back_end.options])


def back_end_options(options: argparse.Namespace) -> dict[str, Any]:
    """The options of the back end that were given."""
    from neuros.backends.registered import AUTO, BACK_ENDS
    from neuros.options import values_of

    if options.backend == AUTO:
        return {}
    values = values_of(BACK_ENDS.load(options.backend).options, options)
    return {name: value for name, value in values.items() if value is not None}


def add_project(command: argparse.ArgumentParser) -> None:
    """Add the options that name a project and change it."""
    command.add_argument(
        "project", nargs="?", metavar="PROJECT", help="a file, or a folder with a project.json"
    )
    command.add_argument(
        "-p", "--project", dest="project_option", metavar="PROJECT", help="the same, as an option"
    )
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        help="change a key of the project: nodes.NAME.KEY...=VALUE,"
        " connections.SRC.OUT.DST.IN.KEY=VALUE or budgets.KEY=VALUE (JSON if it parses; always text"
        " in environment; nothing removes the key)",
    )
    command.add_argument(
        "--namespace",
        metavar="NS",
        help="where nodes, connections and relative topics are on the ROS graph, as in /left, so"
        " that two copies of a project share a domain (default: the project's)",
    )
    command.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="FROM:=TO",
        help="another name for an external topic, or for a topic or service of a plugin, as in ROS"
        " (repeatable); NODE:FROM:=TO for one node alone",
    )


def launch_project(options: argparse.Namespace) -> int:
    """Run ``neuros launch``."""
    from neuros.cli.launch import launch

    return launch(options)


def _add_network(launch: argparse.ArgumentParser) -> None:
    """The options of ``launch``."""
    launch.add_argument(
        "--network",
        action="store_true",
        help="let the nodes find, and be found by, those on other machines of the network"
        " (default: this machine only); everybody there can then read and send packets",
    )
    launch.add_argument(
        "--peers",
        metavar="HOST,...",
        help="the other machines, by address or name, where multicast does not reach them;"
        " implies --network",
    )


def _add_observation(launch: argparse.ArgumentParser) -> None:
    """Add the options of ``neuros launch``."""
    launch.add_argument(
        "-m",
        "--monitor-system-load",
        action="store_true",
        help="write processor, memory, network and threads, of the machine and by node, to"
        " system_load.csv in the run folder, once per second",
    )

    launch.add_argument(
        "--digests",
        action="store_true",
        help="also in process, keep a digest of every packet for `neuros verify`; each packet is"
        " serialised for it there (on the other back ends digests are always kept, in process"
        " where all connections are lossless and it costs under 2 %% of the processor time)",
    )


def _add_recording_options(launch: argparse.ArgumentParser) -> None:
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


def add_recorder(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """What ``launch`` starts; people do not."""
    recorder = commands.add_parser("recorder", add_help=False)
    recorder.add_argument("run")
    recorder.set_defaults(command=_run_recorder)


def _run_recorder(options: argparse.Namespace) -> int:
    from neuros.cli.recorder import run_recorder

    return run_recorder(options)
