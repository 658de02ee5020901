"""The process back end: one host process per node.

A *host* is a process that runs nodes: the launcher's command with the ``node.json`` files of its
nodes appended. It leads a session of its own, so that Ctrl+C reaches only the launcher, and writes
its log itself, so that nothing passes through the launcher and nothing is lost when that dies.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.project.model import NodeFile

_BOOTSTRAP = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
# One thread each: more threads than free cores make numerical libraries slower, not faster, and
# simulators differ in the last bit with their number.
_DEFAULTS = {
    "PYTHONUNBUFFERED": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
# Runs the scripts one after another, each with the log of its node for output; the shell passes
# SIGTERM on to them, and a script that fails ends it. ``exec`` then makes the host of it: same
# process id, nothing in between.
_SCRIPTS = """\
run() {
  name=$1 script=$2 log=$3; shift 3
  "$@" >>"$log" 2>&1 & wait "$!"; code=$?
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


class HostProcess:
    """A host that was started, and the nodes in it (:class:`neuros.ports.RunningNode`)."""

    def __init__(
        self,
        names: Sequence[str],
        arguments: Sequence[str],
        *,
        log: Path,
        folder: Path,
        environment: Mapping[str, str],
    ) -> None:
        """Start it in ``folder``; both its outputs are appended to ``log``.

        Raises ``EnvironmentFault`` if that is impossible.
        """
        self._names = tuple(names)
        self._log = log
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            with open(log, "ab") as output:
                self._process = subprocess.Popen(
                    list(arguments),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    cwd=folder,
                    env=dict(environment),
                    start_new_session=True,
                )
        except OSError as error:
            nodes = ", ".join(self._names)
            raise EnvironmentFault(f"cannot start the process of {nodes}: {error}") from error

    @property
    def names(self) -> tuple[str, ...]:
        return self._names

    @property
    def pid(self) -> int:
        """Its process id, which is also that of its process group and session."""
        return self._process.pid

    def poll(self) -> str | None:
        """``None`` while it runs, then how it ended, in words."""
        code = self._process.poll()
        if code is None:
            return None
        return (_script_failure(self._log) if code == 1 else None) or _in_words(code)

    def wait(self, timeout_s: float) -> str | None:
        """As :meth:`poll`, after it has ended or ``timeout_s`` seconds have passed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return self.poll()

    def terminate(self) -> None:
        self._process.terminate()

    def kill(self) -> None:
        """Kill it and its whole process group."""
        # Once it has been reaped, its number may be another's.
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)


class ProcessLauncher:
    """Starts one host per node (:class:`neuros.ports.Launcher`).

    Args:
        command: the host program; the paths of ``node.json`` files are appended to it.
        on_started: called with the process id of each host as soon as it exists.
    """

    def __init__(
        self, command: Sequence[str], on_started: Callable[[int], None] | None = None
    ) -> None:
        self._command = tuple(command)
        self._on_started = on_started

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[HostProcess]:
        """Start a host per node, all or none. Raises ``EnvironmentFault``."""
        hosts: list[HostProcess] = []
        try:
            for node in nodes:
                host = HostProcess(
                    [node.node.name],
                    host_arguments(self._command, [node]),
                    log=log_file(node),
                    folder=node.folders.run,
                    environment=host_environment(
                        os.environ, {**node_environment(node), **environment}
                    ),
                )
                hosts.append(host)
                if self._on_started:
                    self._on_started(host.pid)
        except BaseException:
            end_now(hosts)
            raise
        return hosts

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per host."""
        return [
            f"process {node.node.name}: {shlex.join(host_command(self._command, [node]))}"
            f" (log: {log_file(node)})"
            for node in nodes
        ]


def node_folder(node: NodeFile) -> Path:
    """The node's own folder in the run folder."""
    return node.folders.run / node.node.name


def log_file(node: NodeFile) -> Path:
    """Where the output of a node goes."""
    return node_folder(node) / "node.log"


def node_environment(node: NodeFile) -> dict[str, str]:
    """What a node finds in its environment besides what all find there."""
    return {**node.node.environment, "NEUROS_RUN_DIR": str(node_folder(node))}


def host_environment(base: Mapping[str, str], added: Mapping[str, str]) -> dict[str, str]:
    """The environment of a host: ``base`` (the launcher's own) with ``added`` on top.

    The ROS wheels restart every Python of their environment once, with library paths and a mark;
    a host of another environment that inherited the mark would find no libraries.
    """
    environment = dict(base)
    if environment.pop(_BOOTSTRAP, None) is not None:
        given = environment.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
        inside = str(Path(sys.prefix))
        kept = [path for path in given if path and not _is_inside(path, inside)]
        if kept:
            environment["LD_LIBRARY_PATH"] = os.pathsep.join(kept)
    return {**_DEFAULTS, **environment, **added}


def host_command(command: Sequence[str], nodes: Sequence[NodeFile]) -> list[str]:
    """The host program for these nodes, without their scripts."""
    return [*command, *(str(node_folder(node) / "node.json") for node in nodes)]


def host_arguments(command: Sequence[str], nodes: Sequence[NodeFile]) -> list[str]:
    """What to execute for these nodes: their scripts, one after another, and then the host.

    A script runs in a process of its own in its node's environment; what it changes there does
    not reach the node. What it prints goes to the log of its node.
    """
    host = host_command(command, nodes)
    scripts = [_script_line(node, node.node.script) for node in nodes if node.node.script]
    if not scripts:
        return host
    program = [_SCRIPTS.rstrip("\n"), *scripts, "trap - TERM", f"exec {shlex.join(host)}"]
    return ["/bin/sh", "-c", "\n".join(program)]


def end_now(hosts: Sequence[HostProcess]) -> None:
    """Kill hosts and wait until they are gone."""
    for host in hosts:
        host.kill()
    for host in hosts:
        host.wait(5.0)


def _script_line(node: NodeFile, script: Path) -> str:
    variables = [f"{key}={value}" for key, value in node_environment(node).items()]
    start = [str(script)] if os.access(script, os.X_OK) else ["/bin/sh", str(script)]
    return shlex.join(
        ["run", node.node.name, str(script), str(log_file(node)), "env", *variables, *start]
    )


def _is_inside(path: str, folder: str) -> bool:
    return path == folder or path.startswith(f"{folder}{os.sep}")


def _script_failure(log: Path) -> str | None:
    """What the last line of a host's log says of a script that failed, if that is what it says."""
    with contextlib.suppress(OSError), open(log, "rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
        lines = file.read().decode(errors="replace").splitlines()
        match = _SCRIPT_FAILED.fullmatch(lines[-1]) if lines else None
        if match:
            return f"script {match['script']} of '{match['node']}' failed: {match['how']}"
    return None


def _in_words(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:  # a real-time signal
        return f"killed by signal {-code}"
