"""``neuros replay``: a recorded run replayed to one node, or published on the ROS graph."""

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

from neuros.distribution import python_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.suggest import counted

if TYPE_CHECKING:
    from neuros.api.run_record import PastRun
    from neuros.bag import RecordedTopic
    from neuros.hooks import HookSpec
    from neuros.project.model import NodeFile
    from neuros.replay.replayed_node import ReplayedNode


_LEAST_RATE, _LONGEST_DELAY_S = 1e-6, 1e6
_HIGHEST_PORT = (1 << 16) - 1

EXIT_IDENTICAL, EXIT_DIFFERENT, EXIT_UNKNOWN, EXIT_LEFT = 0, 1, 2, 130


def add_replay(replay: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    replay.description = (
        "With --node: run one node again on exactly the packets that it received, and compare what"
        " it sends, packet by packet. With --topic: publish recorded topics on the ROS graph, at"
        " the intervals of the run."
    )
    replay.epilog = (
        "exit codes of --node: 0 identical, 1 different, 2 nothing to compare,"
        " 4 the node needs what this machine does not have"
    )
    add = replay.add_argument
    add("run", metavar="RUN", help="the run folder, or a bag")
    add("-n", "--node", metavar="NAME", help="the node to run again")
    debugger = replay.add_mutually_exclusive_group()
    debugger.add_argument(
        "--pdb",
        "--debug",
        action="store_true",
        help="with --node: run it in Python's debugger, which stops at the start of each hook, and"
        " after a failure",
    )
    debugger.add_argument(
        "--debugpy",
        type=int,
        metavar="PORT",
        help="with --node: wait until an editor's debugger attaches to this port (pip install"
        " debugpy)",
    )
    add(
        "-o",
        "--output",
        metavar="FOLDER",
        help="with --node: keep the files that the node writes (node.run_dir) in this folder"
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
    """Add the arguments of the program that ``replay --node`` becomes."""
    replayed.add_argument("node_file")
    replayed.add_argument("--run", required=True)
    replayed.add_argument("--pdb", action="store_true")
    replayed.add_argument("--debugpy", type=int)
    replayed.add_argument("--remove", action="store_true")
    replayed.set_defaults(command=_replayed)


def _replay(options: argparse.Namespace) -> int:
    if options.debugpy is not None and not 0 < options.debugpy <= _HIGHEST_PORT:
        raise UsageError(f"replay: --debugpy must be a port from 1 to {_HIGHEST_PORT}")
    if options.remap:
        return _replay_bag(options, options.node)
    if options.node is not None:
        return _replay_node(options)
    if options.pdb or options.debugpy is not None or options.output is not None:
        raise UsageError("replay: --pdb, --debugpy and --output need --node NAME")
    if not options.replay_topics:
        raise UsageError(
            "replay: name a node to run again (--node NAME), or what to publish (--topic NAME, or"
            " --topic '*' for all)"
        )
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
        chosen = [t for t in bag.chosen(options.replay_topics) if _can_publish(t, options)]
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


def _can_publish(topic: RecordedTopic, options: argparse.Namespace) -> bool:
    """Whether ROS here has the type of a topic; one that was named by itself is required.

    Raises:
        EnvironmentFault: if it is required.
    """
    try:
        why = topic.misfit
    except EnvironmentFault as fault:
        why = str(fault)
    if why and topic.name in options.replay_topics:
        raise EnvironmentFault(f"replay: {topic.name} cannot be published: {why}")
    if why:
        print(f"neuros: {topic.name} is not published: {why}", file=sys.stderr)
    return not why


def _replay_bag(options: argparse.Namespace, name: str | None) -> int:
    """Give topics of a bag to a node of a project."""
    from neuros.bag import open_bag
    from neuros.replay.bag_into_node import replay_into, rules_of
    from neuros.testing import PluginHarness

    if name is None:
        raise UsageError("replay: --remap needs the node that gets the packets: --node NAME")
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


def _replay_node(options: argparse.Namespace) -> int:
    """Become the process in which the node is replayed; returns only if that is interrupted.

    The node runs in this very process (``exec``), which becomes one like those of a run: with the
    Python, the environment and the script of the node, and with the terminal, for debuggers.

    Raises:
        UsageError: if the run, the node or the recording is not there.
        EnvironmentFault: if the node's Python cannot be made.
    """
    if options.replay_topics:
        raise UsageError("replay: --node runs a node, --topic publishes: choose one of them")
    from neuros.cli.environments import require_messages
    from neuros.distribution import WORKSPACE
    from neuros.messages.workspace import message_cache
    from neuros.node.keeping import RESTORED
    from neuros.replay.from_container import as_on_this_machine
    from neuros.replay.recorded_node import RecordedNode, recorded_node

    run, file = recorded_node(Path(options.run).absolute(), options.node)
    file = as_on_this_machine(run, file, WORKSPACE, message_cache(os.environ))
    require_messages(file)
    if not (file.node.module or file.node.plugin.is_file()):
        raise UsageError(f"replay: the plugin of '{options.node}' is gone: {file.node.plugin}")
    RecordedNode(run, file)
    python, ended = _python(run, file)
    if ended:
        return ended
    folder = _folder(options.output)
    if file.restored:
        shutil.copytree(run.folder / options.node / RESTORED, folder / options.node / RESTORED)
    file = replace(file, folders=replace(file.folders, run=folder))
    command = python_command("neuros.cli", "replayed", "--run", str(run.folder), python=python)
    command += ["--pdb"] if options.pdb else []
    command += ["--debugpy", str(options.debugpy)] if options.debugpy is not None else []
    command += [] if options.output else ["--remove"]
    _become(command, file)
    return 0


def _python(run: PastRun, file: NodeFile) -> tuple[Path, int]:
    """The Python of the node, made if necessary, and the exit code of a signal meanwhile, else 0.

    Raises:
        EnvironmentFault: if it cannot be made.
    """
    from neuros.backends.pythons import Pythons
    from neuros.cli.environments import make_shown_environments
    from neuros.registry import ran_in_one_process
    from neuros.replay.from_container import not_here, ran_in_container

    own = [] if ran_in_one_process(run.record) else [file.node]
    try:
        pythons = Pythons.choose(own, file.folders.project, dict(os.environ))
        ended = make_shown_environments(pythons, [])
    except EnvironmentFault as fault:
        raise not_here(run, file.node.name, fault) if ran_in_container(run) else fault from fault
    return pythons.paths.get(file.node.name, Path(sys.executable)), ended


def _replayed(options: argparse.Namespace) -> int:
    """The process that :func:`_replay_node` becomes."""
    from neuros.api.run_record import open_run
    from neuros.project.split import node_file_from_json
    from neuros.recording.provenance import python_versions
    from neuros.replay.from_container import note_on_versions, ran_in_container
    from neuros.replay.recorded_node import RecordedNode
    from neuros.replay.replayed_node import ReplayedNode, debugpy_on, files_changed_since

    faulthandler.enable()
    os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    file = node_file_from_json(json.loads(Path(options.node_file).read_text("utf-8")))
    if options.remove:
        atexit.register(shutil.rmtree, file.folders.run, ignore_errors=True)
    run_folder = Path(options.run)
    run = open_run(run_folder)
    for path in files_changed_since(run_folder, file):
        print(f"note: {path} was changed after the run had begun")
    if ran_in_container(run) and (note := note_on_versions(run, file.node.name, python_versions())):
        print(f"note: {note}")
    node = ReplayedNode(file, RecordedNode(run, file))
    with debugpy_on(options.debugpy):
        sys.stdout.flush()
        is_left = _run(node, use_pdb=options.pdb)
    return _verdict(node, run, file.node.name, is_left=is_left)


def _run(node: ReplayedNode, *, use_pdb: bool) -> bool:
    """Replay the node; returns whether the user has left a debugger."""
    from neuros.replay.replayed_node import Debugger, is_quit

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


def _verdict(node: ReplayedNode, run: PastRun, name: str, *, is_left: bool) -> int:
    from neuros.replay.from_container import missing_module, not_here, ran_in_container

    compared = node.comparison
    packets = (
        f"{counted(compared.packets, 'packet')} on {counted(compared.connections, 'connection')}"
    )
    if is_left:
        print(f"left after {counted(node.starts, 'start')} of hooks; identical so far: {packets}")
        return EXIT_LEFT
    if node.failure is not None and node.difference is None:
        # The run ended with a failure of this node, at this very start of a hook.
        record = run.record
        is_named = bool(record["exit_code"]) and name in record["reason"]
        if not is_named or node.expects_start:
            if ran_in_container(run) and (lack := missing_module(node.failure)):
                raise not_here(run, name, lack)
            first = str(node.failure).partition("\n")[0]
            print(f"different: it failed, but did not in the run: {first}")
            return EXIT_DIFFERENT
        node.notes.append(f"it failed, as in the run: {node.failure}")
    for note in node.notes:
        print(f"note: {note}")
    if node.difference is not None:
        print(f"different: {node.difference}")
        return EXIT_DIFFERENT
    if not compared.packets and node.has_outputs and (node.notes or not compared.connections):
        print("unknown: its packets were not recorded")
        return EXIT_UNKNOWN
    what = packets if compared.connections else "it sends nothing"
    print(f"identical: {what}; {counted(node.starts, 'start')} of hooks")
    return EXIT_IDENTICAL


def _folder(output: str | None) -> Path:
    """The run folder of the replayed node."""
    if output is None:
        import tempfile

        return Path(tempfile.mkdtemp(prefix="neuros-replay-"))
    from neuros.api.run_folder import make_run_folder

    return make_run_folder(output, "replay")


def _become(command: Sequence[str], file: NodeFile) -> None:
    from neuros.backends.node_command import (
        node_environment,
        process_environment,
        start_arguments,
        start_environment,
        with_messages,
    )
    from neuros.project.split import node_file_text

    own = file.folders.run / file.node.name
    own.mkdir(exist_ok=True)  # what was restored to the node is there
    (own / "node.json").write_text(node_file_text(file), "utf-8")
    added = {
        **node_environment(file),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF",  # it has no neighbours
        "ROS_LOG_DIR": str(file.folders.run),
    }
    environment = start_environment(
        command, [file], with_messages(process_environment(os.environ, added), file.messages)
    )
    arguments = start_arguments(command, [file])
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os.chdir(file.folders.run)
    os.execve(shutil.which(arguments[0]) or arguments[0], arguments, environment)
