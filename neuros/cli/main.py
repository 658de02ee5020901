"""``neuros``: the parser, the commands, and the exit codes.

=== ===========================================================
0   ended normally
1   a node failed or had to be killed, a deadlock, or a lossless connection lost a packet
2   wrong usage of the command line
3   invalid project
4   something is missing on this machine (package, engine, image), or what was to be recorded
    could not be written
5   a budget of the project was broken
130 ended by Ctrl+C
143 ended by SIGTERM, or because the terminal was closed
=== ===========================================================

Heavy imports are late: ``neuros --help`` must not wait for them.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any

from neuros import __version__
from neuros.cli.bag import add_bag
from neuros.cli.benchmark import add_benchmark
from neuros.cli.build import add_build
from neuros.cli.containers import add_containers
from neuros.cli.convert import add_convert
from neuros.cli.dashboard import add_dashboard, add_dashboard_options
from neuros.cli.doctor import add_doctor
from neuros.cli.network import add_network
from neuros.cli.observation import add_observation
from neuros.cli.recording_options import add_recorder, add_recording_options
from neuros.cli.replay import add_replay
from neuros.cli.report import add_report
from neuros.cli.reproduce import add_reproduce
from neuros.cli.sessions import add_sessions
from neuros.cli.sweep import add_sweep
from neuros.cli.verify import add_verify
from neuros.cli.views import add_view, add_view_options
from neuros.errors import EnvironmentFault, NeurosError, ProjectError, UsageError
from neuros.project.suggest import did_you_mean

EXIT_NODE, EXIT_USAGE, EXIT_PROJECT, EXIT_ENVIRONMENT, EXIT_INTERRUPTED = 1, 2, 3, 4, 130

_EXIT_CODES = """\
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


class _Parser(argparse.ArgumentParser):
    """A mistyped option is refused by the command that was named, with the usage of that one.

    argparse hands it up to the first parser, whose usage has commands only.
    """

    def parse_known_args(self, *args: Any, **kwargs: Any) -> Any:
        """As argparse does, but nothing stays unknown."""
        options, unknown = super().parse_known_args(*args, **kwargs)
        if unknown:
            hint = did_you_mean(unknown[0].partition("=")[0], self._option_string_actions)
            unknown_text = f"unrecognized arguments: {' '.join(unknown)}"
            self.error(f"{unknown_text} ({hint})" if hint else unknown_text)
        return options, unknown


def console_script() -> None:
    """Run the command that the process was started with, and end the process."""
    sys.exit(main(sys.argv[1:]))


def main(arguments: Sequence[str]) -> int:
    """Run one command; returns its exit code. Errors are written for the user."""
    _open_standard_streams()
    if not arguments:
        parser().print_help(sys.stderr)
        return EXIT_USAGE
    try:
        options = parser().parse_args(arguments)
        if options.command is not _launch:  # that has Ctrl+C wait until it can heed it
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        code = int(options.command(options))
        if sys.stdout is not None:
            sys.stdout.flush()  # so that a reader that has gone is noticed here
        return code
    except ProjectError as error:
        _complain(str(error))
        count = len(error.problems)
        _complain(f"{count} problem{'' if count == 1 else 's'}; {error.outcome}")
        return EXIT_PROJECT
    except UsageError as error:
        _complain(f"neuros: {error}")
        return EXIT_USAGE
    except EnvironmentFault as error:
        _complain(f"neuros: {error}")
        return EXIT_ENVIRONMENT
    except NeurosError as error:
        _complain(f"neuros: {error}")
        return EXIT_NODE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # As in `neuros graph PROJECT | head`: Python must not try again to write, when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0


def parser() -> argparse.ArgumentParser:
    """The whole grammar of the command line."""
    result: argparse.ArgumentParser = _Parser(
        prog="neuros",
        description="Closed loops of simulators, spiking networks and robots, on ROS 2.",
        epilog=_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--version", action="version", version=f"neuros {__version__}")
    commands = result.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_launch(commands)
    _add_validate(commands)
    _add_graph(commands)
    add_build(commands)
    add_sessions(commands)
    add_sweep(commands)
    add_verify(commands)
    add_report(commands)
    add_bag(commands)
    add_replay(commands)
    add_convert(commands)
    add_doctor(commands)
    add_containers(commands)
    add_benchmark(commands)
    add_reproduce(commands)
    _add_node(commands)
    _add_import_plugin(commands)
    add_recorder(commands)
    add_dashboard(commands)
    add_view(commands)
    return result


def _add_launch(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    launch = commands.add_parser(
        "launch",
        help="run a project",
        description="Run a project: start its nodes, connect them, and stay until all have ended.",
        epilog=_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_project(launch)
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
    add_network(launch)
    launch.add_argument(
        "--backend",
        choices=("auto", "docker", "process", "in-process"),
        default=os.environ.get("NEUROS_BACKEND") or "auto",
        help="where nodes run: each in a container, each in a process, or all in one process"
        " (default: NEUROS_BACKEND, else auto: docker where an engine has the images, and else"
        " process)",
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
    add_observation(launch)
    add_dashboard_options(launch)
    add_view_options(launch)
    add_recording_options(launch)
    launch.add_argument(
        "--progress",
        action=argparse.BooleanOptionalAction,
        help="show how far the run has come: a line that stays, or, where standard output is no"
        " terminal, a line every 10 s (default: if it is known when the run ends)",
    )
    launch.add_argument("--dry-run", action="store_true", help="print what would be started")
    launch.add_argument("-v", "--verbose", action="store_true", help="show DEBUG records, too")
    launch.set_defaults(command=_launch)


def _add_validate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    validate = commands.add_parser(
        "validate",
        help="check a project without running it",
        description="Check a project and list every problem with its file, line and column."
        " Plugins are read, and not run.",
    )
    _add_project(validate)
    validate.add_argument(
        "--import",
        dest="imports",
        action="store_true",
        help="import the plugin of each node, too, as its process would: their code is run, but no"
        " hook",
    )
    validate.set_defaults(command=_validate)


def _add_graph(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    graph = commands.add_parser(
        "graph",
        help="show the nodes and connections of a project",
        description="Show the nodes and connections of a project without running it.",
    )
    _add_project(graph)
    graph.add_argument(
        "--format",
        choices=("text", "mermaid", "svg"),
        help="for the terminal, a Mermaid diagram for Markdown, or a picture (default: text, unless"
        " the name of the file ends in .mmd or .svg)",
    )
    graph.add_argument("-o", "--output", metavar="FILE", help="write it there, not to the terminal")
    graph.set_defaults(command=_graph)


def _add_node(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """What containers and processes run; it is started by ``launch``, not by people."""
    node = commands.add_parser("node", add_help=False)
    node.add_argument("node_files", nargs="+")
    node.add_argument("--in-memory", action="store_true")
    node.add_argument("--duration-sim", type=float)
    node.add_argument("--digests", action="store_true")
    node.add_argument("--debug", action="store_true")
    node.add_argument("--record", action="store_true")
    node.set_defaults(command=_node)


def _add_import_plugin(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """What ``validate --import`` runs for each node."""
    command = commands.add_parser("import-plugin", add_help=False)
    command.add_argument("name")
    command.add_argument("project")
    command.add_argument("--set", action="append", default=[])
    command.add_argument("--answer", type=int, required=True)
    command.set_defaults(command=_import_plugin)


def _add_project(command: argparse.ArgumentParser) -> None:
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


def _launch(options: argparse.Namespace) -> int:
    from neuros.cli.launch import launch

    return launch(options)


def _validate(options: argparse.Namespace) -> int:
    from neuros.cli.projects import validate

    return validate(options)


def _import_plugin(options: argparse.Namespace) -> int:
    from neuros.cli.projects import import_plugin

    return import_plugin(options)


def _graph(options: argparse.Namespace) -> int:
    from neuros.cli.graph import write_graph

    return write_graph(options)


def _node(options: argparse.Namespace) -> int:
    from neuros.cli.node import run_node

    return run_node(options)


def _complain(text: str) -> None:
    with contextlib.suppress(OSError):  # nobody reads it
        print(text, file=sys.stderr)


def _open_standard_streams() -> None:
    """Where one of the three was closed, its number would go to the next file that is opened."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
