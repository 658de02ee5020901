"""``neuros``: the commands, their parser, and their errors.

Only the module of the command that runs is imported: every node starts through this one.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import gc
import os
import signal
import sys
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any, NoReturn

from neuros.cli import EXIT_CODES
from neuros.cli.terminal import harmless_output
from neuros.distribution import versions
from neuros.errors import EnvironmentFault, NeurosError, ProjectError, UsageError
from neuros.options import positive_number, positive_seconds
from neuros.ordinary_files import cannot_be_opened
from neuros.ports import Subcommand
from neuros.project.suggest import counted, did_you_mean, listed
from neuros.registry import SUBCOMMANDS

_NOT_OPENED = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP),
)
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
EXIT_NODE, EXIT_USAGE, EXIT_PROJECT, EXIT_ENVIRONMENT, EXIT_INTERRUPTED = 1, 2, 3, 4, 130


COMMANDS = {
    "new": Subcommand("neuros.cli.projects", "make a small project to start with"),
    "example": Subcommand("neuros.cli.projects", "list the examples, or copy one"),
    "launch": Subcommand("neuros.cli.launch", "run a project"),
    "validate": Subcommand("neuros.cli.projects", "check a project without running it"),
    "graph": Subcommand("neuros.cli.projects", "show the nodes and connections of a project"),
    "types": Subcommand(
        "neuros.cli.projects", "let editors know the fields of a project's messages"
    ),
    "build": Subcommand("neuros.cli.machine", "build message packages"),
    "ps": Subcommand("neuros.cli.live", "show the runs of this user"),
    "stop": Subcommand("neuros.cli.live", "stop a run, as Ctrl+C does"),
    "topic": Subcommand("neuros.cli.live", "show the topics and packets of a run in progress"),
    "logs": Subcommand("neuros.cli.live", "show what the nodes of a run have logged"),
    "verify": Subcommand("neuros.cli.runs", "compare the packets of two runs"),
    "bag": Subcommand("neuros.cli.runs", "show or complete what a run has recorded"),
    "doctor": Subcommand("neuros.cli.machine", "check this machine, and prove that packets arrive"),
    "containers": Subcommand(
        "neuros.cli.machine", "build, list and remove the images that nodes run in"
    ),
    "benchmark": Subcommand(
        "neuros.cli.machine", "measure what NeuROS costs, compared with the same program without it"
    ),
    "reproduce": Subcommand("neuros.cli.machine", "repeat the published experiments"),
    "node": Subcommand("neuros.cli.node"),
    "import-plugin": Subcommand("neuros.cli.projects"),
    "recorder": Subcommand("neuros.cli.recorder"),
}
"""Of NeuROS itself; ``neuros.registry.SUBCOMMANDS`` has those of extensions."""


_WANTED: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    positive_number: "a whole number from 1 on",
    positive_seconds: "a number above 0",
}


# Their output goes to a log, or to a program.
_FOR_PROGRAMS = {"node", "import-plugin", "recorder"}
_COMMAND = "COMMAND"
_IN_WORDS = {
    "expected one argument": "needs a value",
    "expected at least one argument": "needs a value",
    "ignored explicit argument": "takes no value, but is given",
    "the following arguments are required:": "name it on the command line, it is missing:",
}


class _Formatter(argparse.HelpFormatter):
    """Fills paragraphs, and leaves lists of exit codes as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if "\n" in text else super()._fill_text(text, width, indent)


class _Parser(argparse.ArgumentParser):
    """A mistyped option is refused by the command that was named, with the usage of that one.

    argparse hands it up to the first parser, whose usage has commands only.
    """

    prepare: Callable[[argparse.ArgumentParser, Sequence[str]], None] | None = None

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does, but nothing stays unknown."""
        if self.prepare is not None:
            self.prepare(self, args)
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            hint = did_you_mean(unknown[0].partition("=")[0], self._option_string_actions)
            unknown_text = f"unrecognized arguments: {' '.join(unknown)}"
            self.error(f"{unknown_text} ({hint})" if hint else unknown_text)
        return options, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """As argparse does, with a suggestion, or the extension that has the command."""
        if action.choices is None or value in action.choices:
            return
        shown = [str(each) for each in action.choices]
        if isinstance(action, argparse._SubParsersAction):
            shown = _with_help(action)
            if action.metavar == _COMMAND and (missing := SUBCOMMANDS.missing(value)):
                raise argparse.ArgumentError(None, missing)
        hint = did_you_mean(str(value), shown)
        if action.option_strings:
            text = f"must be {listed(shown)}, but is '{value}'"
            raise argparse.ArgumentError(action, f"{text} ({hint})" if hint else text)
        what = str(action.metavar or action.dest).lower()
        hint = hint or f"there are {', '.join(shown)}"
        raise argparse.ArgumentError(None, f"there is no {what} '{value}' ({hint})")

    def _get_value(self, action: argparse.Action, text: str) -> Any:
        """As argparse does, but names the wanted value in words, not by a function."""
        try:
            return super()._get_value(action, text)
        except argparse.ArgumentError as error:
            wanted = _WANTED.get(action.type) if action.type in _WANTED else None
            if wanted is None:
                raise
            raise argparse.ArgumentError(action, f"'{text}' is not {wanted}") from error

    def error(self, message: str) -> NoReturn:
        """As argparse does, in words that say what to do."""
        for said, meant in _IN_WORDS.items():
            message = message.replace(said, meant)
        super().error(message)

    def _print_message(self, message: str, file: Any = None) -> None:
        """As argparse does, but a help that cannot be written is an error."""
        if message and file is not None and file is sys.stdout:
            file.write(message)
        else:
            super()._print_message(message, file)


def console_script() -> None:
    """Run the command that the process was started with, and end the process."""
    sys.exit(main(sys.argv[1:]))


def main(arguments: Sequence[str]) -> int:
    """Run one command; returns its exit code. Errors are written for the user."""
    if "_ARGCOMPLETE" in os.environ:  # a shell asks what fits: this ends the process
        _complete(os.environ.get("COMP_LINE", ""))
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file would get its number
            os.open(os.devnull, os.O_RDWR)
    if _command_in(arguments) in _FOR_PROGRAMS:
        return _main(arguments)
    with harmless_output():
        return _main(arguments)


def _main(arguments: Sequence[str]) -> int:
    # As in nodes. NumPy would start threads on its import, which spin for 50 ms.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not arguments:
        parser("").print_help(sys.stderr)
        return EXIT_USAGE
    try:
        command = _command_in(arguments)
        gc.disable()
        try:
            options = parser(command).parse_args(arguments)
        except SystemExit:  # after a help or a version
            _flush()
            raise
        finally:
            _keep_for_good()
            gc.enable()
        if command != "launch":  # launch unblocks Ctrl+C when it can handle it
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        code = int(options.command(options))
        _flush()
        return code
    except ProjectError as error:
        _complain(str(error))
        _complain(f"{counted(len(error.problems), 'problem')}; {error.outcome}")
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
        _give_up_output()  # as in `neuros graph PROJECT | head`
        return 0
    except OSError as error:
        if error.errno in _NO_ROOM:
            _give_up_output()
            what = error.filename or "the output, or a file,"
            _complain(f"neuros: {what} could not be written ({error.strerror})")
            return EXIT_ENVIRONMENT
        if error.errno not in _NOT_OPENED or error.filename is None:
            raise
        _complain(f"neuros: {cannot_be_opened(error)}")
        return EXIT_USAGE


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser of the command line, with all options; ``command``: with those of this one."""
    result = _Parser(
        prog="neuros",
        description="Run closed loops of simulators, spiking networks and robots on ROS 2.",
        epilog=EXIT_CODES,
        formatter_class=_Formatter,
    )
    text = "show the versions of neuros and its extensions, and exit"
    result.add_argument("--version", action=_Versions, nargs=0, help=text)
    commands = result.add_subparsers(title="commands", metavar=_COMMAND, required=True)
    shown = COMMANDS
    if command not in COMMANDS:  # what extensions bring takes some 10 ms to find
        shown = COMMANDS | {name: SUBCOMMANDS.load(name) for name in SUBCOMMANDS}
    for name, each in shown.items():
        is_whole = command in (None, name)
        if each.help:
            added = commands.add_parser(name, help=each.help, formatter_class=_Formatter)
        else:
            added = commands.add_parser(name, add_help=False)
        if is_whole:
            module = import_module(each.module)
            getattr(module, f"add_{name.replace('-', '_')}")(added)
            prepare = getattr(module, f"prepare_{name}", None)
            if prepare is not None and (command is None or "_ARGCOMPLETE" in os.environ):
                prepare(added, ["--help"])  # argcomplete does not see options that come later
            else:
                added.prepare = prepare
    return result


class _Versions(argparse.Action):
    """Looks for extensions, which takes some 10 ms, only where it is asked to."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(versions())
        parser.exit()


@cache
def _keep_for_good() -> None:
    """Freeze all imported objects; once, since Python programs may run many commands.

    Rounds of the garbage collector through them took 25 ms of the processor time of a launch.
    """
    gc.freeze()


def _command_in(words: Sequence[str]) -> str:
    return next((word for word in words if not word.startswith("-")), "")


def _complete(line: str) -> None:
    """Answer a shell that completes a command line of ``neuros`` or ``launch.py``."""
    import argcomplete

    program, *words = line.split() or [""]
    is_launch = program.endswith("launch.py")
    completed = parser("launch" if is_launch else _command_in(words))
    (commands,) = (
        each for each in completed._actions if isinstance(each, argparse._SubParsersAction)
    )
    if is_launch:
        completed = commands.choices["launch"]
    argcomplete.autocomplete(
        completed, exclude=[*(set(commands.choices) - {*_with_help(commands)})]
    )


def _with_help(commands: argparse._SubParsersAction[Any]) -> list[str]:
    """The commands for people; NeuROS itself starts the others."""
    return [each.dest for each in commands._choices_actions]


def _flush() -> None:
    """Raise errors of writing here, and not when Python ends."""
    if sys.stdout is not None:
        sys.stdout.flush()


def _give_up_output() -> None:
    """Keep Python from writing again when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _complain(text: str) -> None:
    with contextlib.suppress(OSError):  # its reader has gone
        print(text, file=sys.stderr)
