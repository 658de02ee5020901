"""Another machine of a run: the launcher's end of the connection to the agent there.

The monotonic clock of each machine has its own origin. So times in reports and packet logs of nodes
there are shifted by the difference, which is known up to half of the round trip of a message.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from msgspec import structs

import neuros_cluster.messages as agent
from neuros.backends.node_command import without_mark
from neuros.control import FROM_NODES, Message, NodeStatus, Report
from neuros.control.link import decode, decoder_of, to_bytes
from neuros.distribution import WORKSPACE, __version__
from neuros.errors import ControlError, EnvironmentFault
from neuros.ordinary_files import reason_of, write_whole
from neuros.ports import ControlStream
from neuros.project.model import Folders
from neuros.stacks import ProcessThreads
from neuros_cluster.deployment_file import Host
from neuros_cluster.files import chunks_of, scan, write_chunk
from neuros_cluster.pump import Pump

_SSH = ("-T", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10")
_CONNECT_S = 60.0
_WORKSPACE = "workspace"
_MOST_UNSENT_BYTES = 1 << 20
_POLL_S = 0.05
_COMMAND_NOT_FOUND = 127
_ENDS_S = 5.0
_PACKET_LOG = "packets"  # of a node, in its folder
_EXITS_S = 0.5
_READ_S = 3.0
_LAST_BYTES = 2000

Log = Callable[[str, str], None]
_Kind = TypeVar("_Kind", bound=Message)


class Machine:
    """A machine on which an agent runs nodes of a project.

    Args:
        host: the way to reach it.
        timeout_s: a machine that is silent for longer counts as gone.
        log: receives lines for the user, as ``(severity, text)``; in any thread.
        command: starts the agent, as a child process of this one.

    Attributes:
        lost: why the connection is lost, empty while it is not.
        clock: the offset of its clocks.
        folders: of the project there, once it is placed.
        fault: the first file that could not be kept here, and why; empty without one.
    """

    def __init__(self, host: Host, timeout_s: float, log: Log, command: Sequence[str]) -> None:
        self.host = host
        self.lost = ""
        self.clock = ClockOffset()
        self._timeout_s = timeout_s
        self._log = log
        self.folders: Folders
        self._control: Callable[[], ControlStream] | None = None
        self._run: Path | None = None
        self._ends: dict[str, str] = {}
        self._threads: dict[str, ProcessThreads] = {}
        self.fault = ""
        self._is_closed = False
        self._answers: list[Message] = []
        self._arrived = threading.Condition()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the connection
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=without_mark(os.environ),
                start_new_session=True,
            )
        except OSError as error:
            raise self._failed(f"{command[0]} cannot be started ({error.strerror})") from error
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._pump = Pump(
            os.dup(self._process.stdout.fileno()),
            os.dup(self._process.stdin.fileno()),
            agent.FROM_AGENT,
            host.name,
            self._handle,
            self._lose,
            connect=self._connect,
            translate=self.clock.data_here,
        )
        # The agent notices the end when the pump closes its copies.
        self._process.stdin.close()
        self._process.stdout.close()
        self._pump.start()

    # ------------------------------------------------------------------ before the run

    def greet(self) -> agent.Ready:
        """Wait until the agent is up.

        Raises:
            EnvironmentFault: the agent does not come up, or has another version.
        """
        ready = self._await(agent.Ready, _CONNECT_S)
        if ready.version != __version__:
            raise self._failed(
                f"NeuROS {ready.version} is installed there, but {__version__} here: install the"
                " same version on both"
            )
        self._pump.timeout_s = self._timeout_s
        return ready

    def place(self, project: Path) -> int:
        """Send the project and the workspace; returns the number of sent files.

        Raises:
            EnvironmentFault: that is impossible.
        """
        name = project.name if project.name != _WORKSPACE else ""
        folders = {name or "project": project, _WORKSPACE: WORKSPACE}
        trees = tuple(scan(name, folder) for name, folder in folders.items())
        self._pump.send(agent.Place(trees, self._timeout_s))
        lacking = self._await(agent.Lacking).paths
        for (name, folder), paths in zip(folders.items(), lacking, strict=True):
            for path in paths:
                self._send_file(folder / path, f"{name}/{path}")
        self._pump.send(agent.Sent())
        placed = self._await(agent.Placed)
        self.folders = Folders(Path(placed.project), Path(placed.workspace), Path(placed.run))
        return sum(map(len, lacking))

    def prepare(self, nodes: Sequence[Mapping[str, object]]) -> tuple[Path, ...]:
        """Make environments and message packages there; returns the packages' folders.

        Raises:
            EnvironmentFault: with all failures.
        """
        self._pump.send(agent.Prepare(tuple(nodes)))
        return tuple(map(Path, self._await(agent.Prepared).messages))

    def examine(self) -> Sequence[tuple[str, str, str, str]]:
        self._pump.send(agent.Examine())
        return self._await(agent.Examined).findings

    # ------------------------------------------------------------------ the run

    @property
    def pid(self) -> int:
        """The process that reaches the machine; it leads a session of its own."""
        return self._process.pid

    def begin(
        self,
        start: agent.Start,
        run: Path,
        given: Iterable[Path],
        control: Callable[[], ControlStream],
    ) -> None:
        """Start the nodes; :meth:`await_started` waits.

        Args:
            run: the run folder here.
            given: files in there that the nodes need.
            control: connects to the supervisor.

        Raises:
            EnvironmentFault: a file cannot be read.
        """
        self._run, self._control = run, control
        for path in given:
            self._send_file(path, path.relative_to(run).as_posix())
        self._pump.send(start)

    def await_started(self) -> None:
        """Wait until all nodes have been started. Raises ``EnvironmentFault``."""
        self._await(agent.Started)

    def kill(self, node: str) -> None:
        self._pump.send(agent.KillNode(node))

    def threads_of(self, node: str) -> ProcessThreads:
        """The positions of threads in a node's Python code; waits up to 3 s for the answer."""
        with self._arrived:
            self._threads.pop(node, None)
        if not self.lost:
            self._pump.send(agent.ReadThreads(node))
        with self._arrived:
            self._arrived.wait_for(lambda: node in self._threads or self.lost, _READ_S)
            return self._threads.get(node, ProcessThreads(problem=self.lost or "no answer came"))

    def end_of(self, node: str) -> str | None:
        """How the process of a node has ended, ``None`` while it runs."""
        if node in self._ends:
            return self._ends[node]
        return f"{self.host.name} cannot be reached any more: {self.lost}" if self.lost else None

    def finish(self, is_enough: Callable[[], bool]) -> agent.Finished | None:
        """Copy all files of the nodes to this machine; ``None`` if that failed."""
        if self.lost or self._run is None:
            self.close()
            return None
        self._pump.send(agent.Finish())
        try:
            return self._await(agent.Finished, is_enough=is_enough)
        except EnvironmentFault:
            return None
        finally:
            self.close()

    def move_times(self, nodes: Sequence[str]) -> None:
        """Shift the times of copied packet logs to the clock of this machine."""
        if self._run is None:
            return
        for node in nodes:
            try:
                self.clock.log_here(self._run / node / _PACKET_LOG)
            except OSError as error:
                why = f"the packet log of {node} cannot be moved: {reason_of(error)}"
                self.fault = self.fault or why

    def close(self) -> None:
        """Close the connection; the agent ends what is left. Callable from any thread."""
        with self._arrived:
            self._is_closed = True
            self._arrived.notify_all()
        self._pump.end()
        if self._pump is not threading.current_thread():
            self._pump.join(_ENDS_S)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDS_S)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    # ------------------------------------------------------------------ inside

    def _handle(self, message: Message) -> None:
        """Handle a message of the agent, in the thread of the pump."""
        match message:
            case agent.Pong():
                self.clock.add(message, time.monotonic(), time.time())
            case agent.Chunk():
                if self._run is None:
                    return
                try:
                    size = write_chunk(self._run, message)
                except OSError as error:
                    size = len(message.data)
                    what = f"{message.path} of {self.host.name}"
                    self.fault = self.fault or f"{what} cannot be written: {reason_of(error)}"
                self._pump.send(agent.Took(size))
            case agent.Remark(severity, text):
                self._log(severity, f"{self.host.name}: {text}")
            case agent.NodeEnded(node, how):
                self._ends[node] = how
            case agent.ThreadsRead(node, read):
                with self._arrived:
                    self._threads[node] = read
                    self._arrived.notify_all()
            case _:
                if isinstance(message, agent.Finished):
                    self._pump.end()  # the end of the agent is no fault from now on
                with self._arrived:
                    self._answers.append(message)
                    self._arrived.notify_all()

    def _lose(self, reason: str) -> None:
        code = None
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_EXITS_S)
        if code is None:
            self._process.kill()  # ssh would retry for minutes
        errors = self._errors.fileno()
        end = os.pread(errors, _LAST_BYTES, max(0, os.fstat(errors).st_size - _LAST_BYTES))
        lines = end.decode("utf-8", "replace").strip().splitlines()
        said = lines[-1].strip() if lines else ""  # the last line: the reason of the program's end
        if code == _COMMAND_NOT_FOUND and not self.host.docker:
            said += f": name the command neuros there in /hosts/{self.host.name}/neuros"
        with self._arrived:
            self.lost = f"{reason} ({said})" if said else reason
            if self._run is not None:
                where = f"{self.host.way}:{self.folders.run}"
                self.lost += f"; files that were not copied are still in {where}"
            self._arrived.notify_all()

    def _connect(self) -> ControlStream:
        if self._control is None:
            raise ConnectionRefusedError
        return self._control()

    def _await(
        self,
        kind: type[_Kind],
        limit_s: float | None = None,
        is_enough: Callable[[], bool] = lambda: False,
    ) -> _Kind:
        """Wait for the next answer, of this kind. Raises ``EnvironmentFault``."""
        end_s = None if limit_s is None else time.monotonic() + limit_s
        with self._arrived:
            while not self._answers:
                self._require_open()
                if is_enough() or (end_s is not None and time.monotonic() > end_s):
                    raise self._failed("it did not answer in time")
                self._arrived.wait(_POLL_S)
            answer = self._answers.pop(0)
        if isinstance(answer, agent.Refused):
            raise self._failed(answer.text)
        assert isinstance(answer, kind), f"{kind.__name__} was expected, not {answer}"
        return answer

    def _require_open(self) -> None:
        if self.lost or self._is_closed:
            raise self._failed(self.lost or "it is not needed any more")

    def _failed(self, text: str) -> EnvironmentFault:
        return EnvironmentFault("\n".join(f"{self.host}: {line}" for line in text.splitlines()))

    def _send_file(self, path: Path, name: str) -> None:
        try:
            for chunk in chunks_of(path, name):
                while self._pump.unsent_bytes > _MOST_UNSENT_BYTES:
                    self._require_open()  # after Ctrl+C the pump has stopped writing
                    time.sleep(_POLL_S)
                self._require_open()
                self._pump.send(chunk)
        except OSError as error:
            raise EnvironmentFault(
                f"{path} cannot be read, and other machines need it: {error.strerror}"
            ) from error


def agent_command(host: Host) -> list[str]:
    """The command that starts the agent of a machine, as a child process of this one."""
    if host.through:
        return [*host.through, os.path.expanduser(host.neuros), "agent"]
    neuros = host.neuros
    home, rest = ("~/", neuros[2:]) if neuros.startswith("~/") else ("", neuros)
    remote = f"exec {home}{shlex.quote(rest)} agent"
    return [*ssh_command(host), "--", host.ssh, remote]


def ssh_command(host: Host) -> list[str]:
    """``ssh`` with the options for a machine, without its destination."""
    return ["ssh", *_SSH, *host.ssh_options]


_MOST_DRIFT = 1e-4
"""Drift of two clocks in seconds per second: crystals are exact to 1e-4."""

# Files of a packet log: width of a row, and the columns with times.
_TIMES: Mapping[str, tuple[int, tuple[int, ...]]] = {
    "sent_ns": (1, (0,)),
    "taken_ns": (1, (0,)),
    "executions": (3, (1, 2)),
    "credits": (3, (2,)),
    "pauses": (2, (0, 1)),
}


@dataclass
class ClockOffset:
    """Difference of another machine's clocks from this one's, in seconds; positive: ahead.

    Clocks drift apart, so the error of an answer grows with its age, as in NTP (RFC 5905,
    dispersion): half of its round trip, plus the possible drift since. The answer with the smallest
    error counts.

    Attributes:
        round_trip_s: of that answer.
        monotonic_s, unix_s: the differences of the monotonic clocks, and of the times of day, at
            that answer.
    """

    round_trip_s: float = float("inf")
    monotonic_s: float = 0.0
    unix_s: float = 0.0
    _known_at_s: float = 0.0
    _course: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, pong: agent.Pong, now_s: float, now_unix_s: float) -> None:
        """Add an answer that arrives now, by the clocks of this machine."""
        round_trip_s = now_s - pong.sent_s
        drift_s = _MOST_DRIFT * (now_s - self._known_at_s)
        if round_trip_s / 2 < self.round_trip_s / 2 + drift_s:
            self.round_trip_s, self._known_at_s = round_trip_s, now_s
            ahead_s = pong.monotonic_s - (now_s - round_trip_s / 2)
            # Containers of one machine share a clock.
            self.monotonic_s = ahead_s if abs(ahead_s) > round_trip_s else 0.0
            self.unix_s = pong.unix_s - (now_unix_s - round_trip_s / 2)
            # Drop earlier answers that this one beats even at their own moments.
            at_s, error_s = pong.monotonic_s, round_trip_s / 2
            while self._course:
                earlier_s, _, earlier_error_s = self._course[-1]
                if earlier_error_s <= error_s + _MOST_DRIFT * (at_s - earlier_s):
                    break
                self._course.pop()
            self._course.append((at_s, self.monotonic_s, error_s))

    @property
    def is_known(self) -> bool:
        return self.round_trip_s < float("inf")

    def data_here(self, data: bytes) -> bytes:
        """The bytes of a message of a node there, with its times on the clock of this machine."""
        try:
            return to_bytes(self.message_here(decode(data, decoder_of(tuple(FROM_NODES)), "")))
        except ControlError:  # the supervisor reports the mistake
            return data

    def message_here(self, message: Message) -> Message:
        """A message of a node there, with its times on the clock of this machine."""
        shift_s, shift_ns = self.monotonic_s, round(1e9 * self.monotonic_s)
        if isinstance(message, Report):
            since_s = message.running_since_s
            return structs.replace(
                message,
                running_since_s=None if since_s is None else since_s - shift_s,
                timeline=tuple((sim_s, wall_s - shift_s) for sim_s, wall_s in message.timeline),
            )
        if isinstance(message, NodeStatus):
            counters = message.counters and structs.replace(
                message.counters,
                now_s=message.counters.now_s - shift_s,
                sent_ns={
                    key: (position, tuple(at_ns - shift_ns for at_ns in times))
                    for key, (position, times) in message.counters.sent_ns.items()
                },
                taken_ns={
                    key: (position, at_ns - shift_ns)
                    for key, (position, at_ns) in message.counters.taken_ns.items()
                },
            )
            # The first value of each row of a sample is its time.
            samples = {
                port: {**each, "values": [[row[0] - shift_s, *row[1:]] for row in each["values"]]}
                if each.get("values")
                else each
                for port, each in message.samples.items()
            }
            return structs.replace(message, counters=counters, samples=samples)
        return message

    def log_here(self, folder: Path) -> None:
        """Shift the times in the packet log of a node there. Raises ``OSError``."""
        import numpy as np

        if not self._course:
            return
        at_s, ahead_s, _ = zip(*self._course, strict=True)
        for file in sorted(folder.glob("*")):
            # Names are as 3.taken_ns, or 3.taken_ns.524288 for a later part.
            what = next((part for part in file.name.split(".") if part in _TIMES), "")
            width, columns = _TIMES.get(what, (1, ()))
            if columns:
                data = file.read_bytes()
                entries = np.frombuffer(data[: len(data) // 8 * 8], np.int64).copy()
                for column in columns:
                    times = entries[column::width]
                    # Interpolated between two answers.
                    times -= np.rint(1e9 * np.interp(1e-9 * times, at_s, ahead_s)).astype(np.int64)
                write_whole(file, entries.tobytes())
