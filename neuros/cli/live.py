"""``neuros ps``, ``stop``, ``topic`` and ``logs``: runs in progress, from another terminal.

None of them needs ROS 2. The nodes sample packets, as for the dashboard, and send the samples over
the control channel: this works on every back end, and with --isolate.
"""

from __future__ import annotations

import argparse
import json
import os
import pwd
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.backends.sessions import RunOnThisMachine, sessions
from neuros.backends.shared_memory import remove_dead_runs
from neuros.cli.common import JSON, add_format, print_json
from neuros.errors import EnvironmentFault, UsageError
from neuros.options import positive_number
from neuros.project.suggest import did_you_mean, listed

if TYPE_CHECKING:
    from neuros.control import NodeStatus

_RUN = "the id that `neuros ps` shows (its first digits are enough), or the name of a project"
_ECHO_PERIOD_S = 0.1
_HZ_PERIOD_S = 1.0
_POLL_S = 0.05
_SHOWN = 8  # digits of a run's id
_REMARK_S = 10.0  # nodes that save something may take any time
_FILTERS = ("run", "project", "node", "backend", "state")
_LIVES_S = 1.0


# ---------------------------------------------------------------------- ps and stop


def add_ps(ps: argparse.ArgumentParser) -> None:
    ps.description = (
        "Show the nodes of all runs of this user on this machine; for root, of all users."
    )
    ps.add_argument("-q", "--quiet", action="store_true", help="only the ids of runs")
    ps.add_argument(
        "-f",
        "--filter",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="show only nodes with this value; KEY is run, project, node, backend or state"
        " (repeatable)",
    )
    add_format(ps)
    ps.set_defaults(command=_ps)


def add_stop(stop: argparse.ArgumentParser) -> None:
    stop.description = (
        "Stop runs of this user, as Ctrl+C in their terminal does, and wait until they have ended."
        " Root can stop a run of another user, but only by its id."
    )
    stop.add_argument(
        "runs",
        nargs="*",
        metavar="RUN",
        help=f"{_RUN}; not needed if there is only one run",
    )
    stop.add_argument("--all", action="store_true", help="stop all runs of this user")
    stop.set_defaults(command=_stop)


@dataclass(frozen=True)
class _RunningNode:
    """A row of ``neuros ps``."""

    run: str
    user: str
    project: str
    node: str
    backend: str
    since: float
    state: str
    folder: str


def _ps(options: argparse.Namespace) -> int:
    found = sessions()
    wanted = [text.partition("=")[::2] for text in options.filter]
    for text, (key, _) in zip(options.filter, wanted, strict=True):
        if "=" not in text or key not in _FILTERS:
            raise UsageError(f"ps: --filter {text}: it must be KEY=VALUE, with {listed(_FILTERS)}")
    rows = [
        row
        for session in found
        for row in _rows(session)
        if all(getattr(row, key).startswith(value) for key, value in wanted)
    ]
    if options.quiet:
        for run in dict.fromkeys(row.run for row in rows):
            print(run[:_SHOWN])
    elif options.format == JSON:
        print_json(rows)
    elif not rows:
        print("no running node matches" if found else "nothing is running")
    else:
        print(_table(rows, shows_users=not all(session.is_own for session in found)))
    return 0


def _rows(session: RunOnThisMachine) -> Iterator[_RunningNode]:
    prefix = f"{session.namespace}/" if session.namespace else ""
    try:
        user = pwd.getpwuid(session.user).pw_name
    except KeyError:
        user = str(session.user)
    for node, state in session.states().items():
        machine = session.elsewhere.get(node)
        yield _RunningNode(
            session.run,
            user,
            session.project,
            prefix + node,
            f"{session.backend} on {machine}" if machine else session.backend,
            session.since,
            state,
            session.folder,
        )


def _table(rows: Sequence[_RunningNode], *, shows_users: bool) -> str:
    from tabulate import tabulate

    cells = []
    for row in rows:
        since = datetime.fromtimestamp(row.since).strftime("%Y-%m-%d %H:%M:%S")
        users = [row.user] if shows_users else []
        head = [row.run[:_SHOWN], *users, row.project]
        cells.append([*head, row.node, row.backend, since, row.state])
    users = ["user"] if shows_users else []
    header = ["run", *users, "project", "node", "back end", "since", "state"]
    return str(tabulate(cells, headers=header))


def _stop(options: argparse.Namespace) -> int:
    found = sessions()
    chosen = _chosen_runs(options.runs, found, is_all=options.all)
    if not chosen:
        print("you have no run in progress" if found else "nothing is running")
    for session in chosen:
        session.interrupt()
    next_remark_s = time.monotonic() + _REMARK_S
    waiting = {session.run for session in chosen}
    # A run has ended when its guardian has gone.
    while waiting := waiting & {session.run for session in sessions()}:
        if time.monotonic() >= next_remark_s:
            next_remark_s += _REMARK_S
            left = " ".join(sorted(run[:_SHOWN] for run in waiting))
            print(f"still ending: {left}; `neuros stop {left}` once more kills", file=sys.stderr)
        time.sleep(_POLL_S)
    for session in chosen:
        print(f"stopped {session.run[:_SHOWN]} ({session.project}); run folder {session.folder}")
    for name in remove_dead_runs():
        print(f"removed {name} from shared memory: its run was killed, and its guardian, too")
    return 0


def _chosen_runs(
    names: Sequence[str], found: Sequence[RunOnThisMachine], *, is_all: bool
) -> Sequence[RunOnThisMachine]:
    """The named runs among those in progress; without a name, the only one.

    Raises:
        UsageError: for a name without a run, or several runs and no name.
    """
    own = [session for session in found if session.is_own]
    if is_all or (not names and len(own) <= 1):
        return own
    shown = ", ".join(f"{session.run[:_SHOWN]} ({session.project})" for session in own)
    if not names:
        raise UsageError(f"several runs are in progress: name one of {shown}, or give --all")
    for name in names:
        if not any(_is_named(session, name) for session in found):
            raise UsageError(f"you have no run called '{name}'; yours are: {shown or 'none'}")
    return [session for session in found if any(_is_named(session, name) for name in names)]


def _is_named(session: RunOnThisMachine, name: str) -> bool:
    is_project = session.project == name and session.is_own
    return is_project or (bool(name) and session.run.startswith(name))


# ---------------------------------------------------------------------- topic


@dataclass(frozen=True)
class _Topic:
    """A topic of a run.

    Attributes:
        name: on the ROS graph.
        connection: ``a.out -> b.in``; empty for an external topic.
        node, port: the node that samples its packets, and their name there; empty if no node of
            this run does.
    """

    name: str
    type: str
    connection: str
    node: str = ""
    port: str = ""

    @property
    def calls(self) -> set[str]:
        """Its names on the command line."""
        return {self.name, self.connection or self.name, f"{self.node}.{self.port}"}


def add_topic(topic: argparse.ArgumentParser) -> None:
    topic.description = (
        "List the topics of a run in progress, show the packets of a topic, or count them. This"
        " needs no installation of ROS 2, and works with every back end."
    )
    actions = topic.add_subparsers(title="actions", metavar="ACTION", required=True)
    show = actions.add_parser("list", help="show topics, their types and connections")
    show.add_argument("run", metavar="RUN", help=_RUN)
    add_format(show)
    show.set_defaults(command=_list)
    for name, text, command in (
        ("echo", f"show packets, {1 / _ECHO_PERIOD_S:g} per second at most", _echo),
        ("hz", "count the packets of a connection, second by second", _hz),
    ):
        action = actions.add_parser(name, help=text)
        action.add_argument("run", metavar="RUN", help=_RUN)
        action.add_argument(
            "topic",
            metavar="TOPIC",
            help="a topic, an output (node.output) or a connection ('a.out -> b.in')",
        )
        action.add_argument(
            "-n",
            "--count",
            type=positive_number,
            metavar="N",
            help="show this many, then end (default: all, until the run ends)",
        )
        add_format(action)
        action.set_defaults(command=command)


def _list(options: argparse.Namespace) -> int:
    from tabulate import tabulate

    topics = _topics(_run(options.run))
    if options.format == JSON:
        shown = ("name", "type", "connection")
        print_json([{key: getattr(each, key) or None for key in shown} for each in topics])
    else:
        rows = [[each.connection or each.node, each.type, each.name] for each in topics]
        print(tabulate(rows, headers=["connection or node", "type", "topic"]))
    return 0


def _echo(options: argparse.Namespace) -> int:
    session = _run(options.run)
    topic = _named(_topics(session), options.topic)
    wanted = {topic.node: {topic.port: {"all": True}}}
    samples = (status.samples.get(topic.port, {}) for status in _watch(session, wanted, topic.node))
    seen = (sample for sample in samples if "all" in sample or "fault" in sample)
    for sample in islice(seen, options.count):
        if "fault" in sample:
            raise EnvironmentFault(f"{topic.name} cannot be shown: {sample['fault']}")
        if options.format == JSON:
            print(json.dumps(sample["all"]), flush=True)
        else:
            print("".join(f"{path}: {value}\n" for path, value in sample["all"].items()) + "---")
            sys.stdout.flush()
    return 0


def _hz(options: argparse.Namespace) -> int:
    session = _run(options.run)
    topic = _named([each for each in _topics(session) if each.connection], options.topic)
    counters = (status.counters for status in _watch(session, {}, topic.node, _HZ_PERIOD_S))
    sent = ((c.now_s, c.metrics["outgoing"][topic.connection]["sent"]) for c in counters if c)
    pairs = (pair for pair in pairwise(sent) if pair[0][0] < pair[1][0])
    for (then_s, before), (now_s, now) in islice(pairs, options.count):
        per_s = (now - before) / (now_s - then_s)
        if options.format == JSON:
            print(json.dumps({"packets_per_s": per_s}), flush=True)
        else:
            print(f"{per_s:.2f} packets/s", flush=True)
    return 0


def _watch(
    session: RunOnThisMachine,
    wanted: Mapping[str, Mapping[str, Any]],
    node: str,
    period_s: float = _ECHO_PERIOD_S,
) -> Iterator[NodeStatus]:
    """Statuses of a node, one each period until the run is over."""
    from neuros.api.observation import statuses
    from neuros.backends.control_sockets import connect
    from neuros.control import TO_OBSERVERS
    from neuros.control.link import ControlLink

    try:
        link = ControlLink(connect(session.control), TO_OBSERVERS, "the supervisor")
    except OSError as error:
        raise EnvironmentFault(
            f"the run {session.run[:8]} does not answer ({error.strerror}): it is ending"
        ) from error
    return (each for each in statuses(link, lambda: wanted, period_s) if each.node == node)


def _run(name: str) -> RunOnThisMachine:
    """The only run of that name. Raises ``UsageError`` for none or several."""
    found = _chosen_runs([name], sessions(), is_all=False)
    if len(found) > 1:
        several = ", ".join(session.run[:8] for session in found)
        raise UsageError(f"several runs are called '{name}': name one of {several}")
    return found[0]


def _topics(session: RunOnThisMachine) -> list[_Topic]:
    """The topics of a run, in the order of its nodes. Raises ``EnvironmentFault``."""
    found: dict[str, _Topic] = {}
    for name in session.nodes:
        for topic in _topics_of(Path(session.folder, name)):
            if topic.node:
                found[topic.name] = topic
            else:
                found.setdefault(topic.name, topic)
    return [*found.values()]


def _topics_of(folder: Path) -> list[_Topic]:
    """Topics of the node with this folder, whose files the node may have damaged."""
    from neuros.recording.run_file import read_node_file

    again = "`neuros topic` needs it: launch the project again"
    try:
        file = read_node_file(folder)
        node, found = file.node, []
        for c in file.connections:
            name = f"{c.topic}/data"
            if c.source_node == node.name:
                kind = node.output(c.source_output).ros_type
                found.append(_Topic(name, kind, str(c), node.name, c.source_output))
            else:
                found.append(_Topic(name, node.input(c.destination_input).ros_type, str(c)))
        ports = [(p, p.external_topic) for p in node.inputs]
        ports += [(p, p.name) for p in node.outputs]
        for port, sampled in ports:
            if port.external_topic is not None:
                name = file.names.resolve(port.external_topic, node.name)
                found.append(_Topic(name, port.ros_type, "", node.name, sampled or ""))
        return found
    except OSError as error:
        raise EnvironmentFault(
            f"{error.filename} is not there: the run is ending, or somebody has removed its files"
        ) from error
    except EnvironmentFault as fault:
        raise EnvironmentFault(f"{fault}; {again}") from fault
    except KeyError as error:
        raise EnvironmentFault(
            f"{folder / 'node.json'} is broken: it has no port {error}; {again}"
        ) from error


def _named(topics: Sequence[_Topic], wanted: str) -> _Topic:
    for topic in topics:
        if wanted in topic.calls:
            if not topic.node:
                raise UsageError(f"{topic.name}: its sender is in another run; ask that one")
            return topic
    known = sorted({each.connection or each.name for each in topics})
    hint = did_you_mean(wanted, {call for each in topics for call in each.calls})
    raise UsageError(f"no topic '{wanted}' ({hint or f'there is {listed(known)}'})")


# ---------------------------------------------------------------------- logs


def add_logs(logs: argparse.ArgumentParser) -> None:
    logs.description = "Show the log records of all nodes of a run, in the order of time."
    logs.add_argument("run", metavar="RUN", help=f"a run folder; or, for a run in progress, {_RUN}")
    logs.add_argument(
        "-f", "--follow", action="store_true", help="go on with new records until the run has ended"
    )
    logs.add_argument(
        "-n",
        "--node",
        action="append",
        default=[],
        dest="nodes",
        metavar="NAME",
        help="show only the records of this node (repeatable)",
    )
    logs.set_defaults(command=_logs)


def _logs(options: argparse.Namespace) -> int:
    from neuros.backends.console import LogTail, wants_colours
    from neuros.backends.node_command import PROCESS_LOG

    folder = Path(options.run)
    if not (folder / "project.json").is_file():
        folder = Path(_run(options.run).folder)
    session = next((s for s in sessions() if Path(s.folder) == folder.resolve()), None)
    files = {file.parent.name: file.with_name("node.log") for file in folder.glob("*/node.json")}
    for name in options.nodes:
        if name not in files:
            raise UsageError(f"the run has no node '{name}': it has {listed(sorted(files))}")
    if options.nodes:
        files = {name: files[name] for name in options.nodes}
    else:
        files |= {"neuros": folder / PROCESS_LOG, "recorder": folder / "recorder.log"}
        files["launcher"] = folder / "launcher.log"
    colours = wants_colours(sys.stdout, os.environ)
    with LogTail(files, lambda text: print(text, end="", flush=True), colours) as tail:
        while options.follow and session is not None and session.is_led:
            look_s = time.monotonic() + _LIVES_S
            while time.monotonic() < look_s:
                if not tail.poll():
                    time.sleep(_POLL_S)
        tail.drain()
    return 0
