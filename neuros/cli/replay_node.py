"""``neuros replay RUN --node NAME``: one node once more, on exactly what it received.

The node runs in this very process, which becomes a host like those of a run (``exec``): with the
Python, the environment and the script of the node, and with the terminal, for debuggers.
"""

from __future__ import annotations

import argparse
import atexit
import faulthandler
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import NodeFile

if TYPE_CHECKING:
    from neuros.hooks import HookSpec
    from neuros.observe.run_record import PastRun
    from neuros.replay.node import ReplayedNode

EXIT_IDENTICAL, EXIT_DIFFERENT, EXIT_UNKNOWN, EXIT_LEFT = 0, 1, 2, 130


def replay_node(options: argparse.Namespace) -> int:
    """Become the process in which the node is replayed; returns only if that is interrupted.

    Raises:
        UsageError: if the run, the node or the recording is not there.
        EnvironmentFault: if the node's Python cannot be made.
    """
    from neuros.api.workspace import WORKSPACE
    from neuros.cli.messages import require_messages
    from neuros.messages.cache import message_cache
    from neuros.observe.recorded_node import RecordedNode, recorded_node
    from neuros.replay.containers import as_on_this_machine, ran_in_container

    run, file = recorded_node(Path(options.run).absolute(), options.node)
    if ran_in_container(run):
        file = as_on_this_machine(run, file, WORKSPACE, message_cache(os.environ))
    require_messages(file)
    if not file.node.plugin.is_file():
        raise UsageError(f"replay: the plugin of '{options.node}' is gone: {file.node.plugin}")
    RecordedNode(run, file)
    python, ended = _python(run, file)
    if ended:
        return ended
    folder = _folder(options.output)
    file = replace(file, folders=replace(file.folders, run=folder))
    command = [str(python), "-m", "neuros.cli", "replayed", "--run", str(run.folder)]
    command += ["--pdb"] if options.pdb else []
    command += ["--debugpy", str(options.debugpy)] if options.debugpy is not None else []
    command += [] if options.output else ["--remove"]
    _become(command, file)
    return 0


def _python(run: PastRun, file: NodeFile) -> tuple[Path, int]:
    """The Python that a node is replayed with, made if it has to be; and the exit code of a signal
    that ended that, else 0.

    Raises:
        EnvironmentFault: if it cannot be made.
    """
    from neuros.cli.environments import make_shown_environments
    from neuros.launch.environments.pythons import Pythons
    from neuros.replay.containers import not_here, ran_in_container

    own = [] if run.record.get("backend") == "in-process" else [file.node]
    try:
        pythons = Pythons.choose(own, file.folders.project, dict(os.environ))
        ended = make_shown_environments(pythons, [])
    except EnvironmentFault as fault:
        raise not_here(run, file.node.name, fault) if ran_in_container(run) else fault from fault
    return pythons.paths.get(file.node.name, Path(sys.executable)), ended


def run_replayed(options: argparse.Namespace) -> int:
    """The process that :func:`replay_node` becomes."""
    from neuros.observe.provenance import python_versions
    from neuros.observe.recorded_node import RecordedNode
    from neuros.observe.run_record import open_run
    from neuros.project.split import node_file_from_json
    from neuros.replay.containers import note_on_versions, ran_in_container
    from neuros.replay.debugging import debugpy_on
    from neuros.replay.node import ReplayedNode, files_changed_since

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
    """Replay it; returns whether the user has left a debugger."""
    from neuros.replay.debugging import Debugger, is_quit

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
    from neuros.replay.containers import missing_module, not_here, ran_in_container

    compared = node.comparison
    count = f"{_count(compared.packets, 'packet')} on {_count(compared.connections, 'connection')}"
    if is_left:
        print(f"left after {_count(node.starts, 'start')} of hooks; identical so far: {count}")
        return EXIT_LEFT
    if node.failure is not None and node.difference is None:
        if not _failed_alike(node, run.record, name):
            if ran_in_container(run) and (lack := missing_module(node.failure)):
                raise not_here(run, name, lack)
            first = str(node.failure).partition("\n")[0]
            print(f"different: it failed, and did not in the run: {first}")
            return EXIT_DIFFERENT
        node.notes.append(f"it failed, as in the run: {node.failure}")
    for note in node.notes:
        print(f"note: {note}")
    if node.difference is not None:
        print(f"different: {node.difference}")
        return EXIT_DIFFERENT
    if not compared.packets and node.has_outputs and (node.notes or not compared.connections):
        print("unknown: what it sends was not recorded")
        return EXIT_UNKNOWN
    what = count if compared.connections else "it sends nothing"
    print(f"identical: {what}; {_count(node.starts, 'start')} of hooks")
    return EXIT_IDENTICAL


def _failed_alike(node: ReplayedNode, record: Any, name: str) -> bool:
    """Whether the run had ended with a failure of the node, at this very start of a hook."""
    return bool(record["exit_code"]) and name in record["reason"] and not node.expects_start


def _folder(output: str | None) -> Path:
    """What is the run folder for the replayed node."""
    if output is None:
        return Path(tempfile.mkdtemp(prefix="neuros-replay-"))
    from neuros.api.run_folder import make_run_folder

    return make_run_folder(output, "replay")


def _become(command: Sequence[str], file: NodeFile) -> None:
    from neuros.launch.node_command import (
        node_environment,
        process_environment,
        start_arguments,
        start_environment,
        with_messages,
    )
    from neuros.project.split import node_file_to_json

    own = file.folders.run / file.node.name
    own.mkdir()
    (own / "node.json").write_text(json.dumps(node_file_to_json(file), indent=2) + "\n", "utf-8")
    added = {
        **node_environment(file),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
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


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
