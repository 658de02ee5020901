"""Command line, environment, scripts and cores of a node process, with the ROS wheel environment.

The ROS wheels from PyPI install a ``.pth`` file: each Python of their environment looks for their
libraries and restarts itself once, with ``LD_LIBRARY_PATH`` and a mark in the environment. Two
things follow. A child that runs another environment's Python must not inherit the mark: it would
find no libraries. And a child that runs this Python can be given both, so that it need not start
twice.

A node with ``affinity`` has the cores that it names; the kernel places all others. A rule that gave
each node a core of its own was measured and dropped: ``docs/placement.md`` has the figures.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from neuros.ports import NodeProgram
from neuros.project.model import Node, NodeFile

Cores = tuple[int, ...]
"""Numbers of cores, ascending."""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""How many threads the usual numerical libraries start."""

# One thread each: more threads than free cores make numerical libraries slower, not faster, and
# simulators differ in the last bit with their number.
DEFAULTS = {"PYTHONUNBUFFERED": "1", **dict.fromkeys(THREAD_VARIABLES, "1")}
# Runs the scripts one after another, each with the log of its node for output, by themselves where
# they may be executed (seen from where they run, which may be a container); the shell passes
# SIGTERM on to them, and a script that fails ends it. ``exec`` then makes the node process of it:
# same process id, nothing in between.
_SCRIPTS = """\
run() {
  name=$1 script=$2 log=$3; shift 3
  [ -x "$script" ] || set -- "$@" /bin/sh
  "$@" "$script" >>"$log" 2>&1 & wait "$!"; code=$?
  if [ "$code" -ne 0 ]; then
    echo "[FATAL] [$(date +%s.%N)] [$name]: script $script failed: exit code $code"
    exit 1
  fi
}
trap 'trap - TERM; kill -TERM 0' TERM
"""
_SCRIPT_FAILED = re.compile(
    r"\[FATAL\] \[\d+\.\d+\] \[(?P<node>\w+)\]: "
    r"script (?P<script>.*) failed: (?P<how>exit code \d+)"
)
_TAIL_BYTES = 8192
_MARK = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
_LIBRARIES = "LD_LIBRARY_PATH"
_BOOTSTRAPPER = "ros_wheels_bootstrapper"
_RMW = "rmw_fastrtps_cpp"


PROCESS_LOG = "host.log"
"""What a process for all nodes prints that comes from none of them."""


@dataclass(frozen=True)
class NodeProcess:
    """How to start a process that runs nodes.

    Attributes:
        names: of the nodes.
        command: what becomes the node process; it runs the scripts of the nodes before.
        node_program: the command without these scripts.
        environment: the whole of it.
        log: where both its outputs are to be appended.
        folder: the one to start it in.
        cores: those that it is to have; empty: the kernel chooses.
    """

    names: tuple[str, ...]
    command: Sequence[str]
    node_program: Sequence[str]
    environment: Mapping[str, str]
    log: Path
    folder: Path
    cores: Cores = ()

    def __str__(self) -> str:
        names = ", ".join(self.names)
        what = f"one process for {names}" if self.log.name == PROCESS_LOG else f"process {names}"
        return f"{what}{on_cores(self.cores)}: {shlex.join(self.node_program)} (log: {self.log})"


def node_process(
    program: NodeProgram, node: NodeFile, environment: Mapping[str, str]
) -> NodeProcess:
    """The process of one node; ``environment`` is that of the run, without the launcher's own."""
    name = node.node.name
    python = [str(program.pythons[name])] if name in program.pythons else []
    cores = program.cores.get(name, ())
    own = {**node_environment(node), **environment}
    return _process(program.command(python), [node], own, cores, log_file(node))


def common_process(
    program: NodeProgram, nodes: Sequence[NodeFile], environment: Mapping[str, str]
) -> NodeProcess:
    """One process for all nodes, which gives each its own environment."""
    cores = tuple(sorted({core for each in program.cores.values() for core in each}))
    log = nodes[0].folders.run / PROCESS_LOG
    return _process(program.command(), nodes, environment, cores, log)


def _process(
    command: Sequence[str],
    nodes: Sequence[NodeFile],
    environment: Mapping[str, str],
    cores: Cores,
    log: Path,
) -> NodeProcess:
    limits = thread_limits([node.node for node in nodes]) if cores else {}
    whole = with_messages(
        process_environment(os.environ, {**limits, **environment}), nodes[0].messages
    )
    return NodeProcess(
        tuple(node.node.name for node in nodes),
        start_arguments(command, nodes),
        node_command(command, nodes),
        start_environment(command, nodes, whole),
        log,
        nodes[0].folders.run,
        cores,
    )


def node_folder(node: NodeFile) -> Path:
    """The node's own folder in the run folder."""
    return node.folders.run / node.node.name


def log_file(node: NodeFile) -> Path:
    return node_folder(node) / "node.log"


def moved(path: Path, places: Sequence[tuple[Path, Path]]) -> Path:
    """A path in one of the first folders as one in the second; the innermost counts."""
    for here, there in sorted(places, key=lambda pair: -len(pair[0].parts)):
        if path.is_relative_to(here):
            return there / path.relative_to(here)
    return path


def node_environment(node: NodeFile) -> dict[str, str]:
    """Environment variables of one node only."""
    return {**node.node.environment, "NEUROS_RUN_DIR": str(node_folder(node))}


def process_environment(base: Mapping[str, str], added: Mapping[str, str]) -> dict[str, str]:
    """The environment of a node process: ``base`` (the launcher's own) with ``added`` on top.

    The wheels bring one implementation of RMW, whatever a shell with another ROS says; without
    them, as in an image with a ROS of its own, the environment names it.
    """
    rmw = {"RMW_IMPLEMENTATION": _RMW} if find_spec(_BOOTSTRAPPER) else {}
    return {**DEFAULTS, **without_mark(base), **rmw, **added}


def with_messages(environment: Mapping[str, str], messages: Sequence[Path]) -> dict[str, str]:
    """An environment in which Python finds built message packages, before all others."""
    if not messages:
        return dict(environment)
    given = environment.get("PYTHONPATH", "")
    paths = [*map(str, messages), *([given] if given else [])]
    return {**environment, "PYTHONPATH": os.pathsep.join(paths)}


def start_environment(
    command: Sequence[str], nodes: Sequence[NodeFile], environment: Mapping[str, str]
) -> dict[str, str]:
    """``environment`` so that a node process of this Python starts in it without a restart.

    Not where scripts run first: they may run any Python.
    """
    is_this_python = command[0] == sys.executable
    if not is_this_python or any(node.node.script for node in nodes):
        return dict(environment)
    return with_libraries(environment)


def node_command(command: Sequence[str], nodes: Sequence[NodeFile]) -> list[str]:
    """The node program for these nodes, without their scripts."""
    return [*command, *(str(node_folder(node) / "node.json") for node in nodes)]


def start_arguments(command: Sequence[str], nodes: Sequence[NodeFile]) -> list[str]:
    """The command for these nodes: their scripts, one after another, and then the program.

    A script runs in a process of its own in its node's environment; what it changes there does
    not reach the node. What it prints goes to the log of its node.
    """
    program = node_command(command, nodes)
    scripts = []
    for node in nodes:
        if script := node.node.script:
            variables = [f"{key}={value}" for key, value in node_environment(node).items()]
            words = [node.node.name, str(script), str(log_file(node)), "env", *variables]
            scripts.append(shlex.join(["run", *words]))
    if not scripts:
        return program
    lines = [_SCRIPTS.rstrip("\n"), *scripts, "trap - TERM", f"exec {shlex.join(program)}"]
    return ["/bin/sh", "-c", "\n".join(lines)]


def script_failure(log: Path) -> str | None:
    """The failed script that the last line of a log names, ``None`` if it names none."""
    match = _SCRIPT_FAILED.fullmatch(last_line(log))
    return match and f"script {match['script']} of '{match['node']}' failed: {match['how']}"


def signal_in_words(number: int) -> str:
    """The effect of a signal on a process, in words."""
    try:
        return f"killed by {signal.Signals(number).name}"
    except ValueError:  # a real-time signal
        return f"killed by signal {number}"


def last_line(log: Path) -> str:
    """The last line of a log, empty if there is none."""
    with contextlib.suppress(OSError), open(log, "rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
        lines = file.read().decode(errors="replace").splitlines()
        return lines[-1] if lines else ""
    return ""


def without_mark(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment for any program: as it was before this Python restarted itself."""
    given = dict(environment)
    if given.pop(_MARK, None) is not None:
        kept = [path for path in _paths(given.pop(_LIBRARIES, "")) if not _is_ours(path)]
        if kept:
            given[_LIBRARIES] = os.pathsep.join(kept)
    return given


def with_libraries(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment for this Python, which need not restart itself in it.

    The restart would make the same environment. Nothing is added where the wheels do not restart
    Python, or in an unknown way.
    """
    # Each start of this Python has imported it. If not, importing it here would restart us.
    find = getattr(sys.modules.get(_BOOTSTRAPPER), "get_ros_paths", None)
    if find is None or _MARK not in os.environ:
        return dict(environment)
    # The folders that the wheels put in front.
    libraries = sorted(path for path in _paths(str(find())) if _is_ours(path))
    if not libraries:
        return dict(environment)
    given = [path for path in _paths(environment.get(_LIBRARIES, "")) if path not in libraries]
    return {**environment, _LIBRARIES: os.pathsep.join([*libraries, *given]), _MARK: "1"}


def _paths(text: str) -> list[str]:
    return [path for path in text.split(os.pathsep) if path]


def _is_ours(path: str) -> bool:
    prefixes = (str(Path(sys.prefix)), os.path.realpath(sys.prefix))
    return any(path == inside or path.startswith(f"{inside}{os.sep}") for inside in prefixes)


def place(nodes: Sequence[Node]) -> Mapping[str, Cores]:
    """The cores of each node with ``affinity``, by name; also those that this machine lacks."""
    return {node.name: tuple(sorted(node.affinity)) for node in nodes if node.affinity}


def thread_limits(nodes: Sequence[Node]) -> dict[str, str]:
    """The environment that keeps numerical libraries to the cores that nodes have asked for.

    Nodes of one process run one at a time: what the widest of them asked for is enough.
    """
    count = max((len(node.affinity) for node in nodes), default=0)
    return dict.fromkeys(THREAD_VARIABLES, str(count)) if count else {}


def on_cores(cores: Cores | None) -> str:
    """The cores of a node in words, empty where the kernel chooses."""
    if not cores:
        return ""
    return f" on core{'s' if len(cores) > 1 else ''} {', '.join(map(str, cores))}"


def usable_cores() -> frozenset[int]:
    """The cores that this process may use: ``taskset`` and control groups are respected."""
    return frozenset(os.sched_getaffinity(0))
