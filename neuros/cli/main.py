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

from neuros.cli.checkout import add_benchmark, add_reproduce
from neuros.cli.convert import add_convert
from neuros.cli.dashboard import add_dashboard
from neuros.cli.launch_options import (
    EXIT_CODES,
    add_launch,
    add_project,
    add_recorder,
    launch_project,
)
from neuros.cli.replay import add_replay
from neuros.cli.runs import add_bag, add_report, add_sessions, add_verify
from neuros.cli.setup import add_build, add_containers, add_doctor
from neuros.cli.sweep import add_sweep
from neuros.cli.views import add_view
from neuros.distribution import __version__
from neuros.errors import EnvironmentFault, NeurosError, ProjectError, UsageError
from neuros.project.suggest import did_you_mean

EXIT_NODE, EXIT_USAGE, EXIT_PROJECT, EXIT_ENVIRONMENT, EXIT_INTERRUPTED = 1, 2, 3, 4, 130


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
        options = parser(arguments).parse_args(arguments)
        if options.command is not launch_project:  # that has Ctrl+C wait until it can heed it
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


def parser(arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The whole grammar of the command line; it depends on the back end in ``arguments``."""
    result: argparse.ArgumentParser = _Parser(
        prog="neuros",
        description="Closed loops of simulators, spiking networks and robots, on ROS 2.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--version", action="version", version=f"neuros {__version__}")
    commands = result.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add_launch(commands, arguments)
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


def _add_validate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    validate = commands.add_parser(
        "validate",
        help="check a project without running it",
        description="Check a project and list every problem with its file, line and column."
        " Plugins are read, and not run.",
    )
    add_project(validate)
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
    add_project(graph)
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


def _validate(options: argparse.Namespace) -> int:
    from neuros.cli.projects import validate

    return validate(options)


def _import_plugin(options: argparse.Namespace) -> int:
    from neuros.cli.projects import import_plugin

    return import_plugin(options)


def _graph(options: argparse.Namespace) -> int:
    from neuros.cli.projects import write_graph

    return write_graph(options)


def _node(options: argparse.Namespace) -> int:
    from neuros.cli.node import run_node

    return run_node(options)


def _complain(text: str) -> None:
    with contextlib.suppress(OSError):  # its reader has gone
        print(text, file=sys.stderr)


def _open_standard_streams() -> None:
    """Where one of the three was closed, its number would go to the next file that is opened."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
