"""Program of an agent: runs nodes of a project for a launcher on another machine.

The launcher starts it (``ssh pi@robot neuros agent``) and talks to it over its standard input and
output. When the launcher falls silent, or closes these, all nodes end; a guardian ends them where
the agent itself is killed.
"""

from __future__ import annotations

import argparse
import io
import os
import platform
import queue
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import neuros_cluster.messages as messages
from neuros.backends.control_sockets import SOCKET_NAME, UnixListener
from neuros.backends.domain import DomainLock, FileLock, choose_domain
from neuros.backends.guardian import Guardian
from neuros.backends.process_launchers import ProcessLauncher, RunningProcess, end_now
from neuros.backends.pythons import Pythons
from neuros.backends.run_processes import RUN_ID
from neuros.backends.sessions import RunOnThisMachine, mark, this_process
from neuros.control import CONTROL_VARIABLE, Message
from neuros.distribution import __version__
from neuros.errors import EnvironmentFault, NeurosError, ProjectError
from neuros.ports import NodeProgram
from neuros.project.split import node_file_text, node_files_from_json
from neuros.stacks import ProcessThreads
from neuros.transport.dds_profile import as_asked
from neuros_cluster.files import RECEIVED, RUNS, Follower, TreeStore, tree_cache, write_chunk
from neuros_cluster.pump import Pump

if TYPE_CHECKING:
    from neuros.recording.system_load import LoadMonitor

_BUSY_S, _QUIET_S = 0.05, 0.2  # between two looks at the nodes
_MOST_IN_FLIGHT_BYTES = 1 << 19
_STOP_S = 5.0
_KEPT_S = 7 * 24 * 3600.0


def add_agent(agent: argparse.ArgumentParser) -> None:
    agent.add_argument("--in-image", action="store_true")
    agent.set_defaults(command=lambda options: Agent(is_in_image=options.in_image).run())


class Agent:
    """Runs nodes until the launcher ends them, or is gone.

    Args:
        is_in_image: whether it runs in a container, whose image has all that its nodes need.
    """

    def __init__(self, *, is_in_image: bool = False) -> None:
        self._is_in_image = is_in_image
        read_from, write_to = os.dup(0), os.dup(1)
        with open(os.devnull, "rb") as nothing:
            os.dup2(nothing.fileno(), 0)
        os.dup2(2, 1)  # output of libraries must not mix with messages to the launcher
        self._inbox: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._pump = Pump(
            read_from, write_to, messages.TO_AGENT, "the launcher", self._inbox.put, self._lose
        )
        self._cache = tree_cache(os.environ)
        self._store = TreeStore(self._cache)
        self._trees: tuple[messages.Tree, ...] = ()
        self._run: Path | None = None
        self._pythons = Pythons({})
        self._guardian: Guardian | None = None
        self._domain: DomainLock | None = None
        self._mark: FileLock | None = None
        self._monitor: LoadMonitor | None = None
        self._follower: Follower | None = None
        self._processes: dict[str, RunningProcess] = {}
        self._in_flight_bytes = 0
        self._is_lost = self._is_over = self._has_started = False

    def run(self) -> int:
        """Run until the end; returns the exit code."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: self._lose("ended by a signal"))
        self._pump.start()
        reached_at = (os.environ.get("SSH_CONNECTION", "").split() or [""] * 4)[2]
        python = platform.python_version()
        self._pump.send(
            messages.Ready(__version__, python, platform.machine(), platform.node(), reached_at)
        )
        try:
            pause_s = _QUIET_S
            while not (self._is_lost or self._is_over):
                message = self._next(pause_s)
                if message is not None:
                    self._handle(message)
                pause_s = _BUSY_S if self._send_news() else _QUIET_S
        finally:
            # End the nodes that are left, with a signal first; most have noticed the end already.
            for process in self._processes.values():
                process.terminate()
            end_s = time.monotonic() + _STOP_S
            for process in self._processes.values():
                process.wait(max(0.0, end_s - time.monotonic()))
            end_now(tuple(self._processes.values()))
            if self._guardian is not None:
                self._guardian.finish()
            for lock in (self._domain, self._mark):
                if lock is not None:
                    lock.release()
            if not (self._is_lost and self._has_started) and self._run is not None:
                shutil.rmtree(self._run, ignore_errors=True)
        return 1 if self._is_lost else 0

    def _next(self, pause_s: float) -> Message | None:
        try:
            return self._inbox.get(timeout=pause_s)
        except queue.Empty:
            return None

    def _lose(self, _: str) -> None:
        """Note that the launcher is gone. Runs in the pump's thread, or a signal handler."""
        self._is_lost = True
        self._inbox.put(None)
        if not self._has_started:  # pip or a compiler may be running, which the guardian ends
            if self._run is not None:
                shutil.rmtree(self._run, ignore_errors=True)
            os._exit(1)

    def _handle(self, message: Message) -> None:
        try:
            match message:
                case messages.Place():
                    self._pump.timeout_s = message.timeout_s
                    self._begin_to_place(message)
                case messages.Chunk():
                    write_chunk(self._run or self._store.received, message)
                case messages.Sent():
                    self._place()
                case messages.Prepare(nodes):
                    self._prepare(nodes)
                case messages.Start():
                    self._start(message)
                case messages.KillNode(node):
                    if node in self._processes:
                        self._processes[node].kill()
                case messages.ReadThreads(node):
                    # In a thread of its own: reading may take seconds.
                    reading = threading.Thread(
                        target=self._read_threads, args=(node,), name="neuros-stacks", daemon=True
                    )
                    reading.start()
                case messages.Took(size):
                    self._in_flight_bytes -= size
                case messages.Examine():
                    self._examine()
                case messages.Finish():
                    self._finish()
        except (NeurosError, OSError) as error:
            self._pump.send(messages.Refused(str(error)))

    # ------------------------------------------------------------------ before the run

    def _begin_to_place(self, message: messages.Place) -> None:
        self._cache.mkdir(parents=True, exist_ok=True)
        self._store.clean_up()
        remove_old_runs(self._cache)
        self._trees = message.trees
        self._pump.send(messages.Lacking(tuple(map(self._store.lacking, self._trees))))

    def _place(self) -> None:
        project, workspace = map(self._store.place, self._trees)
        self._store.clean_up()
        runs = self._cache / RUNS
        runs.mkdir(exist_ok=True)
        self._run = Path(tempfile.mkdtemp(dir=runs))
        self._pump.send(messages.Placed(str(project), str(workspace), str(self._run)))

    def _prepare(self, nodes: Iterable[Mapping[str, Any]]) -> None:
        from neuros.api.plan import make_environments
        from neuros.messages.needed import Messages
        from neuros.messages.workspace import Workspaces

        if find_spec("rclpy") is None:
            raise EnvironmentFault(
                f"rclpy, the Python library of ROS 2, is not installed for {sys.executable}: run"
                " install.py there"
            )
        if self._is_in_image:
            self._pump.send(messages.Prepared(()))
            return
        files = node_files_from_json(nodes)
        folders, described = files[0].folders, [file.node for file in files]
        workspaces = Workspaces(folders.project / "workspace", folders.workspace, os.environ)
        needed = Messages.of_nodes(described, workspaces)
        if problems := needed.problems():
            raise ProjectError(problems)
        self._pythons = Pythons.choose(described, folders.project, os.environ)
        for notice in self._pythons.notices:
            self._pump.send(messages.Remark("INFO", notice))
        make_environments(self._pythons, needed, _Remarks(self._pump))
        self._pump.send(messages.Prepared(tuple(map(str, needed.paths))))

    def _examine(self) -> None:
        from neuros.doctor.checks import findings, look_at_machine

        look = look_at_machine(os.environ) if self._is_in_image else None
        found = look or findings(os.environ, proves=False)
        self._pump.send(
            messages.Examined(tuple((f.state.value, f.subject, f.text, f.remedy) for f in found))
        )

    # ------------------------------------------------------------------ the run

    def _start(self, order: messages.Start) -> None:
        assert self._run is not None
        files = node_files_from_json(order.nodes)
        names = [file.node.name for file in files]
        for file in files:
            (self._run / file.node.name).mkdir(exist_ok=True)
            (self._run / file.node.name / "node.json").write_text(node_file_text(file), "utf-8")
        given = [path for path in self._run.rglob("*") if path.is_file()]
        known = {path.relative_to(self._run).as_posix() for path in given}
        self._follower = Follower(self._run, names, order.machine, known)
        listener = UnixListener(self._run)
        # The first digits are those of the launcher's run; to guardians it is another run.
        run_id = order.run[:8] + os.urandom(4).hex()
        self._domain = choose_domain(int(order.environment["ROS_DOMAIN_ID"]), os.environ, False)
        session = RunOnThisMachine(
            run_id,
            order.project,
            "process",
            tuple(names),
            str(self._run),
            time.time(),
            this_process(),
            files[0].names.namespace,
            control=listener.address,
        )
        self._has_started = True
        self._guardian = Guardian.start(run_id)
        self._guardian.await_ready()
        self._mark = mark(session)
        for lock in (self._domain, self._mark):
            self._guardian.hold(lock)
        for path in listener.files:
            self._guardian.remove_later(path)
        listener.open()
        self._pump.listen(listener)
        own = {
            RUN_ID: run_id,
            CONTROL_VARIABLE: listener.address,
            "ROS_LOG_DIR": str(self._run),
        }
        program = NodeProgram(
            order.options, order.cores, self._pythons.paths, self._guardian, as_asked(os.environ)
        )
        if order.monitors_load:
            from neuros.api.observation import load_monitor

            self._monitor = load_monitor(run_id, self._run, names, is_one_process=False)
            self._monitor.start()
        started = ProcessLauncher(program).start(files, {**order.environment, **own})
        self._processes = {process.names[0]: process for process in started}
        self._pump.send(messages.Started())

    def _read_threads(self, node: str) -> None:
        process = self._processes.get(node)
        threads = ProcessThreads() if process is None else process.threads()
        self._pump.send(messages.ThreadsRead(node, threads))

    def _send_news(self) -> bool:
        """Send grown files and ends of nodes; returns whether there is more to send."""
        has_sent = False
        assert self._follower is not None or not self._processes
        for name, process in tuple(self._processes.items()):
            how = process.poll()
            assert self._follower is not None
            if how is not None or not self._is_full:
                for chunk in self._follower.grown(name):
                    self._send(chunk)
                    has_sent = True
                    if how is None and self._is_full:
                        # The other nodes come first when the launcher has received this.
                        self._processes[name] = self._processes.pop(name)
                        break
            if how is not None:
                del self._processes[name]
                self._pump.send_last(messages.NodeEnded(name, how))
        return has_sent or self._is_full

    @property
    def _is_full(self) -> bool:
        """Whether the launcher has yet to acknowledge the most bytes that are sent ahead."""
        return self._in_flight_bytes > _MOST_IN_FLIGHT_BYTES

    def _send(self, chunk: messages.Chunk) -> None:
        self._in_flight_bytes += len(chunk.data) * 3 // 4
        self._pump.send(chunk)

    def _finish(self) -> None:
        """Send the rest, as fast as the launcher receives it."""
        load = None if self._monitor is None else self._monitor.stop()
        problem = None if self._monitor is None else self._monitor.failure
        for chunk in self._follower.rest() if self._follower is not None else ():
            self._send(chunk)
            while self._is_full and not self._is_lost:
                message = self._next(_QUIET_S)
                if isinstance(message, messages.Took):
                    self._in_flight_bytes -= message.size
            if self._is_lost:  # the rest stays here
                return
        self._pump.send(messages.Finished(load, (problem,) if problem else ()))
        self._pump.end()
        self._pump.join()
        self._is_over = True


class _Remarks(io.TextIOBase):
    """Sends the messages of making environments to the user at the launcher."""

    def __init__(self, pump: Pump) -> None:
        self._pump = pump

    def write(self, text: str) -> int:
        for line in filter(str.strip, text.splitlines()):
            self._pump.send(messages.Remark("INFO", line))
        return len(text)


def remove_old_runs(cache: Path) -> None:
    """Remove what runs without their launcher have left, after a week."""
    for run in (*(cache / RUNS).glob("*"), *(cache / RECEIVED).glob("*")):
        try:
            is_old = run.stat().st_mtime < time.time() - _KEPT_S
        except OSError:
            continue
        if is_old and not (run / SOCKET_NAME).exists():
            shutil.rmtree(run, ignore_errors=True)
