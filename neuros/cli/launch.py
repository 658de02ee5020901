"""``neuros launch``: runs with console, signals, and exit code.

Modules that run projects are imported late: ``--help`` and completion import this one, too.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.api.request import LaunchOptions
from neuros.backends.guardian import start_guardian
from neuros.cli import EXIT_CODES
from neuros.cli.common import add_project, load_with_messages
from neuros.errors import EnvironmentFault, NeurosError
from neuros.options import add_options, parsed_as, values_of
from neuros.registry import AUTO, BACK_ENDS, LAUNCH

if TYPE_CHECKING:
    from neuros.api.plan import Plan

# <linux/sched.h>, <linux/sockios.h>, <net/if.h>
_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000
_SIOCSIFFLAGS, _IFF_UP = 0x8914, 1

_REMEDY = (
    "run it as root, allow user namespaces (sysctl kernel.unprivileged_userns_clone=1,"
    " kernel.apparmor_restrict_unprivileged_userns=0, user.max_user_namespaces > 0), use"
    " --backend docker, or leave --isolate out"
)


def add_launch(launch: argparse.ArgumentParser) -> None:
    launch.description = "Run a project: start its nodes, connect them, wait until all have ended."
    launch.epilog = EXIT_CODES
    add_project(launch, LaunchOptions)
    launch.set_defaults(command=_launch, extensions=())


def prepare_launch(launch: argparse.ArgumentParser, arguments: Sequence[str]) -> None:
    """Add the options of the back end in the arguments, and of extensions if necessary.

    For ``--help``, add those of all.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--backend", nargs="?")
    first.add_argument("-h", "--help", action="store_true")
    asked, _ = first.parse_known_args(arguments)
    for name in BACK_ENDS if asked.help else {_back_end_of(asked)} - {AUTO}:
        try:
            back_end = BACK_ENDS.load(name)
        except NeurosError as error:
            if not asked.help:
                raise
            launch.add_argument_group(f"back end {name}", str(error))
            continue
        group = launch.add_argument_group(f"back end {name}", f"each node in {back_end.place}")
        add_options(group, [replace(each, group="") for each in back_end.options])
    flags = {word.partition("=")[0] for word in arguments if word.startswith("-")}
    unknown = flags - {*launch._option_string_actions}
    if unknown or asked.help:  # to find them takes some 10 ms
        extensions = [*dict.fromkeys(LAUNCH.load(flag) for flag in LAUNCH)]
        for extension in extensions:
            add_options(launch, extension.options)
        launch.set_defaults(extensions=extensions)
    for flag in sorted(unknown):
        if missing := LAUNCH.missing(flag) or LAUNCH.missing(flag[:2]):  # as in -gz
            launch.error(missing)


def _back_end_of(parsed: argparse.Namespace) -> str:
    return str(parsed.backend or os.environ.get("NEUROS_BACKEND") or AUTO)


def _launch(parsed: argparse.Namespace) -> int:
    """Run a project; returns the exit code."""
    with signals_noted() as (signals, waker), ExitStack() as stack:
        options = parsed_as(LaunchOptions, parsed)
        name, guardian = _back_end_of(parsed), None
        if name != AUTO:
            back_end = BACK_ENDS.load(name)
            values = values_of(back_end.options, parsed)
            given = {key: value for key, value in values.items() if value is not None}
            options = replace(options, backend_options=given)
        project, messages = load_with_messages(parsed)
        # It imports while this process does; but nodes share its network.
        if name != AUTO and back_end.is_forked and not (options.dry_run or options.isolate):
            guardian = start_guardian(back_end)
            stack.callback(guardian.finish)

        from neuros.api.execution import Execution
        from neuros.api.plan import make_plan
        from neuros.cli.environments import make_shown_environments, signals_interrupt

        # Preparing other machines may take minutes.
        heeding = nullcontext() if options.deployment is None else signals_interrupt(signals)
        try:
            with heeding:
                plan = make_plan(project, messages, options, is_tried=not options.dry_run)
        except KeyboardInterrupt:
            return 130 if signals[:1] == [signal.SIGINT] else 143
        if options.dry_run:
            return _dry_run(plan)
        if ended := make_shown_environments(plan.pythons, signals, messages):
            return ended
        # A dashboard listens in the network of the browser, which an isolated run leaves below.
        prepared = [
            each.prepare(
                values_of(each.options, parsed), plan.back_end, is_isolated=options.isolate
            )
            for each in parsed.extensions
        ]
        if options.isolate and not plan.back_end.has_own_network:
            _enter_own_network()
        views = [view for view in prepared if view is not None]
        run = Execution(plan, sys.stdout, signals, waker, views=views, guardian=guardian)
        exit_code = int(run.run()["exit_code"])
        if run.output_failure is not None and not exit_code:
            raise EnvironmentFault(
                f"the run went well, but its output could not be written"
                f" ({run.output_failure.strerror}): {run.folder}/run.json has the table"
            )
        return exit_code


def _enter_own_network() -> None:
    """Enter a Linux network namespace with only loopback, for good: ``--isolate``.

    Child processes inherit the namespace. An ordinary user needs a user namespace around it, with
    the same user id; root does not.

    Raises:
        EnvironmentFault: if this machine forbids namespaces, or this process has threads already.
    """
    import ctypes
    import fcntl
    import struct

    is_root = os.geteuid() == 0
    user, group = os.geteuid(), os.getegid()
    unshare = ctypes.CDLL(None, use_errno=True).unshare
    if unshare(_CLONE_NEWNET if is_root else _CLONE_NEWUSER | _CLONE_NEWNET):
        reason = os.strerror(ctypes.get_errno())
        raise EnvironmentFault(f"--isolate: the run gets no network here ({reason}): {_REMEDY}")
    try:
        if not is_root:
            itself = Path("/proc/self")
            (itself / "setgroups").write_text("deny")
            (itself / "uid_map").write_text(f"{user} {user} 1")
            (itself / "gid_map").write_text(f"{group} {group} 1")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", _IFF_UP))
    except OSError as error:
        raise EnvironmentFault(
            f"--isolate: the run gets no network here ({error.strerror}): {_REMEDY}"
        ) from error


def _dry_run(plan: Plan) -> int:
    from neuros.api.execution import run_domain
    from neuros.api.run_folder import folders_of, recording_of, run_folder_path

    recording = recording_of(plan, os.environ)
    folder = run_folder_path(plan.request.output, plan.project.name, "<utc time>")
    with run_domain(plan, recording) as domain:
        print(f"back end {plan.back_end.name}; {domain.reason}; run folder {folder}")
    messages = plan.messages.describe() if plan.messages else ()
    for line in (
        *plan.pythons.notices,
        *plan.pythons.describe(),
        *messages,
        *(notice for _, notice in plan.notices),
        *plan.launcher().describe(plan.node_files(folders_of(plan, folder))),
    ):
        print(line)
    if recording is not None:
        names = ", ".join([*(topic.name for topic in recording.topics), *recording.listen])
        print(f"recorder: {names or 'nothing'}")
    return 0


@contextmanager
def signals_noted() -> Iterator[tuple[list[int], socket.socket]]:
    """Collect SIGINT and SIGTERM in place of ending by them, until the run is cleaned up.

    Yields the list of signals, and a socket that gets a byte for each, and for each child that has
    ended.
    """
    noted: list[int] = []
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
        numbers.append(signal.SIGHUP)
    previous = {
        number: signal.signal(number, lambda number, _: noted.append(number)) for number in numbers
    }
    previous[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, lambda *_: None)
    waker = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)  # launch.py has blocked them
    try:
        yield noted, reader
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)  # the run is over: signals change nothing
        signal.set_wakeup_fd(waker)
        for number, handler in previous.items():
            # Threads of libraries (NumPy) do not block them.
            is_over = signal.SIGINT in mask and number in numbers
            signal.signal(number, signal.SIG_IGN if is_over else handler)
        reader.close()
        writer.close()
