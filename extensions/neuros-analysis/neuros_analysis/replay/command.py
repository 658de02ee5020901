"""``neuros replay``: the nodes of a recorded run replayed, or its topics published on ROS."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import faulthandler
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.cli.common import JSON, add_format, print_json
from neuros.errors import EnvironmentFault, UsageError
from neuros.options import positive_number
from neuros.project.suggest import counted

if TYPE_CHECKING:
    from neuros.api.run_record import PastRun
    from neuros.hooks import HookSpec
    from neuros_analysis.replay.node_replay import NodeVerdict
    from neuros_analysis.replay.replayed_node import ReplayedNode


_LEAST_RATE, _LONGEST_DELAY_S = 1e-6, 1e6
_HIGHEST_PORT = (1 << 16) - 1

EXIT_LEFT = 130
_EXIT_CODES = {"different": 1, "not replayed": 4, "unknown": 2, "identical": 0}
"""By verdict on a node; of several nodes, the first of these counts."""


def add_replay(replay: argparse.ArgumentParser) -> None:
    replay.description = (
        "Run every node of a recorded run again on exactly the packets that it received, and"
        " compare what it sends, packet by packet. With --node: only this one. With --topic:"
        " publish recorded topics on the ROS graph, at the intervals of the run."
    )
    replay.epilog = (
        "exit codes: 0 all nodes are identical, 1 a node is different, 2 nothing to compare,"
        " 4 a node needs what this machine does not have"
    )
    add = replay.add_argument
    add("run", metavar="RUN", help="the run folder, or a bag")
    add(
        "-n",
        "--node",
        action="append",
        default=[],
        dest="nodes",
        metavar="NAME",
        help="a node to run again (repeatable; default: all); one alone has the terminal",
    )
    add(
        "-j",
        "--jobs",
        type=positive_number,
        metavar="N",
        help="run so many nodes at a time (default: one for each core)",
    )
    add_format(replay)
    debugger = replay.add_mutually_exclusive_group()
    debugger.add_argument(
        "--pdb",
        "--debug",
        action="store_true",
        help="with one --node: run it in Python's debugger, which stops at the start of each hook,"
        " and after a failure",
    )
    debugger.add_argument(
        "--debugpy",
        type=int,
        metavar="PORT",
        help="with one --node: wait until an editor's debugger attaches to this port (pip install"
        " debugpy)",
    )
    add(
        "-o",
        "--output",
        metavar="FOLDER",
        help="keep the files that nodes write (node.run_dir), and their logs, in this folder"
        " (default: remove them)",
    )
    add(
        "-t",
        "--topic",
        action="append",
        default=[],
        dest="replay_topics",
        metavar="NAME",
        help="publish this topic, output (node.output) or connection (repeatable); * stands for"
        " any characters",
    )
    add("--rate", type=float, default=1.0, metavar="FACTOR", help="speed-up (default: 1)")
    add(
        "--delay",
        type=float,
        default=1.0,
        metavar="SECONDS",
        help="wait before the first packet, so that subscribers find the topics (default: 1)",
    )
    add(
        "-w",
        "--wait-matching-subscriptions",
        type=int,
        default=0,
        metavar="N",
        help="begin when each topic has this many subscriptions, as `ros2 topic pub` does"
        " (default: 0)",
    )
    add(
        "-d",
        "--domain-id",
        type=int,
        metavar="ID",
        help="publish in this ROS domain (default: ROS_DOMAIN_ID, else 0)",
    )
    add(
        "-p",
        "--project",
        metavar="PROJECT",
        default=".",
        help="with --remap: the project of the node (default: the current folder)",
    )
    add(
        "--remap",
        action="append",
        default=[],
        metavar="TOPIC:=NODE.PORT",
        help="with --node, of a bag of any program: give this topic to an input of the node, or in"
        " the place of an output that the input is connected with (repeatable)",
    )
    replay.set_defaults(command=_replay)


def add_replayed(replayed: argparse.ArgumentParser) -> None:
    replayed.add_argument("node_file")
    replayed.add_argument("--run", required=True)
    replayed.add_argument("--pdb", action="store_true")
    replayed.add_argument("--debugpy", type=int)
    replayed.add_argument("--remove", action="store_true")
    replayed.add_argument("--verdict", type=Path)
    replayed.set_defaults(command=_replayed)


def _replay(options: argparse.Namespace) -> int:
    if options.debugpy is not None and not 0 < options.debugpy <= _HIGHEST_PORT:
        raise UsageError(f"replay: --debugpy must be a port from 1 to {_HIGHEST_PORT}")
    if options.remap:
        return _replay_bag(options)
    has_debugger = options.pdb or options.debugpy is not None
    if has_debugger and len(options.nodes) != 1:
        raise UsageError("replay: --pdb and --debugpy need one --node NAME")
    if options.replay_topics:
        if options.nodes or options.jobs is not None or options.output is not None:
            raise UsageError(
                "replay: --topic publishes; --node, --jobs and --output run nodes: choose one"
            )
        return _publish(options)
    from neuros_analysis.replay.node_replay import replay_of
    from neuros_analysis.replay.recorded_node import recorded_run, require_end

    run = recorded_run(Path(options.run).absolute())
    require_end(run)
    if len(options.nodes) > 1 or not options.nodes or options.format == JSON:
        if has_debugger:
            text = "replay: --pdb and --debugpy have the terminal: leave --format json out"
            raise UsageError(text)
        return _replay_nodes(options, run)
    replay = replay_of(run, options.nodes[0])
    python, ended = replay.make_python()
    if ended:
        return ended
    arguments = ["--pdb"] if options.pdb else []
    arguments += ["--debugpy", str(options.debugpy)] if options.debugpy is not None else []
    arguments += [] if options.output else ["--remove"]
    folder = _folder(options.output)
    command, environment = replay.start(python, folder, arguments)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os.chdir(folder)
    # This process becomes that of the node, which has the terminal, for debuggers.
    os.execve(command[0], command, environment)
    return 0


def _publish(options: argparse.Namespace) -> int:
    if not _LEAST_RATE <= options.rate < math.inf:
        raise UsageError(f"replay: --rate must be {_LEAST_RATE:g} or more, and finite")
    if not 0 <= options.delay <= _LONGEST_DELAY_S:
        raise UsageError(f"replay: --delay must be from 0 to {_LONGEST_DELAY_S:g} s")
    if options.wait_matching_subscriptions < 0:
        raise UsageError("replay: -w must be 0 or more")
    from neuros.backends.domain import given_domain
    from neuros.bag import open_bag
    from neuros.cli.environments import find_messages_of
    from neuros.transport.ros_topics import RosTopic, play

    domain_id = given_domain(options.domain_id, os.environ)
    find_messages_of(Path(options.run))
    with open_bag(options.run) as bag:
        if bag.damage is not None:
            print(f"neuros: {bag.damage}", file=sys.stderr)
        chosen = []
        for topic in bag.chosen(options.replay_topics):
            try:
                why = topic.misfit
            except EnvironmentFault as fault:
                why = str(fault)
            if not why:
                chosen.append(topic)
            elif topic.name in options.replay_topics:  # it was named by itself
                raise EnvironmentFault(f"replay: {topic.name} cannot be published: {why}")
            else:
                print(f"neuros: {topic.name} is not published: {why}", file=sys.stderr)
        packets = sorted(
            (packet.log_time_ns, topic.name, packet.data)
            for topic in chosen
            for packet in topic.raw()
        )
        sent = play(
            [RosTopic(t.name, t.type, t.is_reliable, t.depth, t.is_latched) for t in chosen],
            packets,
            rate=options.rate,
            delay_s=options.delay,
            subscriptions=options.wait_matching_subscriptions,
            domain_id=domain_id,
        )
    print(f"{sent} packets on {len(chosen)} topics")
    return 0


def _replay_bag(options: argparse.Namespace) -> int:
    """Give topics of a bag to a node of a project."""
    from neuros.bag import open_bag
    from neuros.testing import PluginHarness
    from neuros_analysis.replay.bag_into_node import replay_into, rules_of

    if len(options.nodes) != 1:
        raise UsageError("replay: --remap needs the node that gets the packets: one --node NAME")
    (name,) = options.nodes
    if options.pdb or options.debugpy is not None or options.replay_topics:
        raise UsageError("replay: --remap takes neither --pdb, --debugpy nor --topic")
    rules = rules_of(options.remap)
    project = Path(options.project)
    if not project.exists():
        raise UsageError(f"replay: there is no project {project}: name it with --project")
    folder = None if options.output is None else _folder(options.output)
    with open_bag(options.run) as bag, contextlib.ExitStack() as stack:
        try:
            harness = PluginHarness.from_project(project, name, run_folder=folder)
        except KeyError:
            raise UsageError(f"replay: {project} has no node '{name}'") from None
        stack.enter_context(harness)
        kept = None if folder is None else folder / "bag"
        done = replay_into(harness, bag, rules, keep=kept, log=print)
    for topic, count in done.arrived.items():
        waiting = done.waiting.get(topic, 0)
        rest = f", {waiting} of which waited at the end" if waiting else ""
        print(f"{topic} -> {rules[topic]}: {counted(count, 'packet')}{rest}")
    starts = ", ".join(f"{hook} {count}" for hook, count in done.executions.items())
    print(f"starts of hooks: {starts or 'none'}")
    for output, count in done.sent.items():
        print(f"{name}.{output}: {counted(count, 'packet')}")
    if done.ended is not None:
        print(f"'{name}' ended the project: {done.ended}")
    if kept is not None:
        print(kept)
    return 0


def _replay_nodes(options: argparse.Namespace, run: PastRun) -> int:
    """Replay nodes in processes of their own, and show a table.

    Raises:
        UsageError, EnvironmentFault: if some of them cannot be replayed.
    """
    from tabulate import tabulate

    from neuros.backends.node_command import usable_cores
    from neuros.cli.environments import signals_interrupt
    from neuros_analysis.replay.node_replay import IDENTICAL
    from neuros_analysis.replay.recorded_node import is_cut_off
    from neuros_analysis.replay.whole_run import Replays, replays_of

    replays = replays_of(run, options.nodes or [*run.nodes])
    pythons = []
    for replay in replays:
        python, ended = replay.make_python()
        if ended:
            return ended
        pythons.append(python)
    folder = _folder(options.output)
    jobs = options.jobs or min(len(usable_cores()), len(replays))
    count = iter(range(1, len(replays) + 1))
    signals: list[int] = []

    def tell(verdict: NodeVerdict) -> None:
        of = f"({next(count)} of {len(replays)})"
        print(f"neuros: replayed {verdict.node} {of}: {verdict.verdict}", file=sys.stderr)

    try:
        with signals_interrupt(signals):
            verdicts = Replays(folder, jobs).run(zip(replays, pythons, strict=True), tell)
    except KeyboardInterrupt:
        return EXIT_LEFT
    finally:
        if options.output is None:
            shutil.rmtree(folder, ignore_errors=True)
    notes = [f"{each.node}: {note}" for each in verdicts for note in each.notes]
    if is_cut_off(run):
        notes.insert(0, "the launcher of the run was killed: it is replayed as far as it was kept")
    found = {verdict.verdict for verdict in verdicts}
    code = next((code for verdict, code in _EXIT_CODES.items() if verdict in found), 0)
    if options.format == JSON:
        print_json({"nodes": verdicts, "notes": notes})
        return code
    for note in notes:
        print(f"note: {note}")
    rows = [
        [
            each.node,
            each.hooks,
            each.packets,
            each.verdict + ("" if each.is_whole else ", as far as recorded"),
            each.difference,
        ]
        for each in verdicts
    ]
    header = ["node", "hooks executed", "packets compared", "verdict", "first difference"]
    print(tabulate(rows, header, disable_numparse=True, colalign=("left", "right", "right")))
    packets = counted(sum(each.packets for each in verdicts), "packet")
    hooks = counted(sum(each.hooks for each in verdicts), "start")
    others = [f"{each.node} {each.verdict}" for each in verdicts if each.verdict != IDENTICAL]
    result = ", ".join(others) or f"identical: {counted(len(verdicts), 'node')}"
    print(f"\n{result}; {packets}; {hooks} of hooks")
    return code


def _replayed(options: argparse.Namespace) -> int:
    """The process that replays one node."""
    from neuros.project.split import node_file_from_json
    from neuros.recording.provenance import python_versions
    from neuros_analysis.replay.from_container import note_on_versions, ran_in_container
    from neuros_analysis.replay.node_replay import FAILED, NodeVerdict
    from neuros_analysis.replay.recorded_node import RecordedNode, recorded_run
    from neuros_analysis.replay.replayed_node import ReplayedNode, debugpy_on, files_changed_since

    faulthandler.enable()
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    file = node_file_from_json(json.loads(Path(options.node_file).read_text("utf-8")))
    if options.remove:
        atexit.register(shutil.rmtree, file.folders.run, ignore_errors=True)
    run_folder = Path(options.run)
    run = recorded_run(run_folder)
    notes = [
        f"{path} was changed after the run had begun"
        for path in files_changed_since(run_folder, file)
    ]
    if ran_in_container(run) and (note := note_on_versions(run, file.node.name, python_versions())):
        notes.append(note)
    for note in () if options.verdict else notes:
        print(f"note: {note}")
    node = ReplayedNode(file, RecordedNode(run, file))
    with debugpy_on(options.debugpy):
        sys.stdout.flush()
        is_left = _run(node, use_pdb=options.pdb)
    if is_left:
        compared = _compared(node.comparison.packets, node.comparison.connections)
        starts = counted(node.starts, "start")
        print(f"left after {starts} of hooks; identical so far: {compared}")
        return EXIT_LEFT
    try:
        verdict = _verdict(node, run, file.node.name)
    except EnvironmentFault as fault:
        if options.verdict is None:
            raise
        text = str(fault).removeprefix("replay: ")
        verdict = NodeVerdict(file.node.name, FAILED, difference=text)
    if options.verdict is not None:
        replace(verdict, notes=(*notes, *verdict.notes)).save(options.verdict)
    else:
        for note in verdict.notes:
            print(f"note: {note}")
        text = verdict.difference
        if not text:
            compared = _compared(verdict.packets, verdict.connections)
            what = compared if verdict.connections else "it sends nothing"
            text = f"{what}; {counted(verdict.hooks, 'start')} of hooks"
        print(f"{verdict.verdict}: {text}")
    return _EXIT_CODES[verdict.verdict]


def _run(node: ReplayedNode, *, use_pdb: bool) -> bool:
    """Replay the node; returns whether the user has left a debugger."""
    from neuros_analysis.replay.replayed_node import Debugger, is_quit

    debugger = Debugger() if use_pdb else None

    def around(play: Callable[[], None], specs: Sequence[HookSpec]) -> None:
        if debugger is None:
            play()
        else:
            debugger.run(play, [spec.function for spec in specs])

    try:
        node.run(around)
    except BaseException as error:
        if is_quit(error):
            return True
        raise
    if is_quit(node.failure):
        return True
    if debugger is not None and node.failure is not None:
        debugger.look_at(node.failure.__cause__ or node.failure)
    return False


def _verdict(node: ReplayedNode, run: PastRun, name: str) -> NodeVerdict:
    """The verdict at the end of a replay.

    Raises:
        EnvironmentFault: if a node that ran in a container lacks a module here.
    """
    from neuros_analysis.replay.from_container import missing_module, not_here, ran_in_container
    from neuros_analysis.replay.node_replay import DIFFERENT, IDENTICAL, UNKNOWN, NodeVerdict

    difference = node.difference
    if node.failure is not None and difference is None:
        # The run ended with a failure of this node, at this very start of a hook.
        record = run.record
        is_named = bool(record["exit_code"]) and name in record["reason"]
        if not is_named or node.expects_start:
            if ran_in_container(run) and (lack := missing_module(node.failure)):
                raise not_here(run, name, lack)
            first = str(node.failure).partition("\n")[0]
            difference = f"it failed, but did not in the run: {first}"
        else:
            node.notes.append(f"it failed, as in the run: {node.failure}")
    compared = node.comparison
    verdict = IDENTICAL if difference is None else DIFFERENT
    is_lacking = node.has_outputs and (node.notes or not compared.connections)
    if verdict == IDENTICAL and not compared.packets and is_lacking:
        verdict, difference = UNKNOWN, "its packets were not recorded"
    return NodeVerdict(
        name,
        verdict,
        node.starts,
        compared.packets,
        compared.connections,
        node.is_whole,
        difference or "",
        tuple(node.notes),
    )


def _compared(packets: int, connections: int) -> str:
    return f"{counted(packets, 'packet')} on {counted(connections, 'connection')}"


def _folder(output: str | None) -> Path:
    """The run folder of the replayed node."""
    if output is None:
        import tempfile

        return Path(tempfile.mkdtemp(prefix="neuros-replay-"))
    from neuros.api.run_folder import make_run_folder

    return make_run_folder(output, "replay")
