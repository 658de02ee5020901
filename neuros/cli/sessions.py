"""``neuros ps`` and ``neuros stop``: the runs of this user; root sees those of others, too."""

from __future__ import annotations

import argparse
import pwd
import time
from collections.abc import Sequence
from datetime import datetime

from neuros.errors import EnvironmentFault, UsageError
from neuros.launch.sessions import Session, sessions
from neuros.launch.shared_memory import remove_dead_runs

_SHOWN = 8  # digits of a run's id
_AGAIN_S = 10.0  # nodes have 5 s to drain and 5 s to finalise; then they are killed
_GIVE_UP_S = 30.0
_POLL_S = 0.05


def add_sessions(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add both commands to the parser."""
    ps = commands.add_parser(
        "ps",
        help="show the runs of this user",
        description="Show the nodes of all runs of this user on this machine; for root, of all"
        " users.",
    )
    ps.set_defaults(command=_ps)
    stop = commands.add_parser(
        "stop",
        help="stop a run, as Ctrl+C does",
        description="Stop runs of this user, as Ctrl+C in their terminal does, and wait for it."
        " Root stops a run of another user by its id alone.",
    )
    stop.add_argument(
        "runs",
        nargs="*",
        metavar="RUN",
        help="as `neuros ps` shows it (its first digits are enough), or a project; can be left out"
        " where there is one run only",
    )
    stop.add_argument("--all", action="store_true", help="stop all runs of this user")
    stop.set_defaults(command=_stop)


def _ps(_: argparse.Namespace) -> int:
    found = sessions()
    if not found:
        print("nothing is running")
        return 0
    from tabulate import tabulate

    shows_users = not all(session.is_own for session in found)
    users = ["user"] if shows_users else []
    rows = [row for session in found for row in _rows(session, shows_users=shows_users)]
    print(tabulate(rows, headers=["run", *users, "project", "node", "back end", "since", "state"]))
    return 0


def _rows(session: Session, *, shows_users: bool) -> list[list[str]]:
    since = datetime.fromtimestamp(session.since).strftime("%Y-%m-%d %H:%M:%S")
    users = [_user_name(session.user)] if shows_users else []
    head = [session.run[:_SHOWN], *users, session.project]
    prefix = f"{session.namespace}/" if session.namespace else ""
    return [
        [*head, prefix + node, session.backend, since, state]
        for node, state in session.states().items()
    ]


def _user_name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)


def _stop(options: argparse.Namespace) -> int:
    found = sessions()
    chosen = _chosen(options.runs, found, is_all=options.all)
    if not chosen:
        print("no run of yours goes on" if found else "nothing is running")
    for session in chosen:
        session.interrupt()
    _await_end(chosen)
    for session in chosen:
        print(f"stopped {session.run[:_SHOWN]} ({session.project}); run folder {session.folder}")
    for name in remove_dead_runs():
        print(f"removed {name} from shared memory: its run was killed, and its reaper, too")
    return 0


def _chosen(names: Sequence[str], found: Sequence[Session], *, is_all: bool) -> Sequence[Session]:
    own = [session for session in found if session.is_own]
    if is_all or (not names and len(own) <= 1):
        return own
    shown = ", ".join(f"{session.run[:_SHOWN]} ({session.project})" for session in own)
    if not names:
        raise UsageError(f"several runs: name one of {shown}, or give --all")
    for name in names:
        if not any(_is_named(session, name) for session in found):
            raise UsageError(f"no run of yours is called '{name}'; there are {shown or 'none'}")
    return [session for session in found if any(_is_named(session, name) for name in names)]


def _is_named(session: Session, name: str) -> bool:
    is_project = session.project == name and session.is_own
    return is_project or (bool(name) and session.run.startswith(name))


def _await_end(chosen: Sequence[Session]) -> None:
    """Until the reapers have gone, and with them all that they guard."""
    begin_s = time.monotonic()
    waiting, has_insisted = {session.run for session in chosen}, False
    while waiting := waiting & {session.run for session in sessions()}:
        waited_s = time.monotonic() - begin_s
        if waited_s > _AGAIN_S and not has_insisted:
            has_insisted = True
            for session in chosen:
                if session.run in waiting:
                    session.interrupt()  # the second one kills at once
        if waited_s > _GIVE_UP_S:
            left = ", ".join(sorted(run[:_SHOWN] for run in waiting))
            raise EnvironmentFault(f"not ended after {_GIVE_UP_S:g} s: {left}: see `neuros ps`")
        time.sleep(_POLL_S)
