"""Replay of one node of a recorded run: the plugin on the engine, with recorded packets.

The debuggers of a replay are at the end of the module.
"""

from __future__ import annotations

import bdb
import pdb
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from neuros.api.verify import differing_fields
from neuros.engine.engine import Engine
from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros.hooks import HookSpec
from neuros.node.context import ContextSwitch
from neuros.node.node import NodeRuntime
from neuros.ports import Advance, Inbox, Way
from neuros.project.model import Connection, NodeFile
from neuros.project.timing import REAL
from neuros.runtime.local import LocalLoop, LocalMiddleware, NoTopics
from neuros.transport.envelope import Traffic
from neuros.transport.memory import MemoryTransport
from neuros.transport.messages import RosPackets
from neuros.transport.ros_loop import RosLoop
from neuros_analysis.replay.recorded_node import RecordedNode
from neuros_analysis.replay.script import (
    Player,
    ReplayedEngine,
    ReplayOver,
    ReplayParted,
    Script,
)

_POLL_S = 0.1
_DEBUGPY_HOST = "127.0.0.1"

SIDES = ("the run", "the replay")

Topics: TypeAlias = "Mapping[tuple[Way, str], Sequence[tuple[str, str, Sequence[Any]]]]"
"""By way and port or connection: the name, type and packets of each topic."""

Around = Callable[[Callable[[], None], Sequence[HookSpec]], None]
"""Runs an action, given the hooks of the plugin."""


@dataclass
class _Stream:
    """The packets of one output or input; each of ``topics`` carries all of them."""

    topics: Sequence[tuple[str, str, Sequence[Any]]]
    sent: int = 0


class Comparison:
    """Compares a replayed packet with that of the run (:class:`neuros.ports.PacketRecorder`).

    Args:
        message: makes a message from bytes and the name of its type.
        lacking: topics of which not all packets were recorded.

    Attributes:
        difference: the first difference, in a sentence; ``None`` so far.
    """

    def __init__(
        self, topics: Topics, message: Callable[[bytes, str], Any], lacking: Collection[str] = ()
    ) -> None:
        self._streams = [_Stream(each) for each in topics.values()]
        self._numbers = {key: number for number, key in enumerate(topics)}
        self._message = message
        self._lacking = lacking
        self.difference: str | None = None

    @property
    def packets(self) -> int:
        """How many packets were compared; a packet counts for each connection."""
        return sum(
            min(stream.sent, len(packets))
            for stream in self._streams
            for _, _, packets in stream.topics
        )

    @property
    def connections(self) -> int:
        """How many connections and external topics are compared."""
        return sum(len(stream.topics) for stream in self._streams)

    def stream(self, way: Way, name: str) -> int | None:
        return self._numbers.get((way, name))

    def keep(
        self, stream: int, data: bytes, sim_time_s: float | None, virtual_ns: int | None
    ) -> None:
        """Compare a packet that the replay sends."""
        if self.difference is not None:
            return
        passed = self._streams[stream]
        passed.sent += 1
        for topic, type_name, packets in passed.topics:
            if passed.sent > len(packets) and topic in self._lacking:
                continue
            if passed.sent > len(packets):
                self.difference = (
                    f"{topic}: the replay sends packet {passed.sent}, which the run did not send"
                )
            elif packets[passed.sent - 1].data != data:
                self._compare(topic, type_name, passed.sent, packets[passed.sent - 1].data, data)
            if self.difference is not None:
                passed.sent -= 1
                return

    def find_missing(self) -> None:
        """Compare the numbers of packets, at the end of the replay."""
        for stream in self._streams:
            for topic, _, packets in stream.topics:
                if self.difference is None and stream.sent < len(packets):
                    self.difference = (
                        f"{topic}: the replay ends after packet {stream.sent}, the run has"
                        f" {len(packets)}"
                    )

    def close(self) -> None:
        """Nothing to close."""

    def _compare(
        self, topic: str, type_name: str, number: int, recorded: bytes, data: bytes
    ) -> None:
        """Compare the fields of packets of different bytes, which may differ in padding only."""
        pair = self._message(recorded, type_name), self._message(data, type_name)
        field = next(differing_fields(*pair, sides=SIDES), None)
        if field is not None:
            self.difference = f"{topic}: packet {number} differs in {field}"


class _Loop(LocalLoop):
    """Leaves to the script what the node posts itself, and handles events of threads only."""

    def __init__(self, script: Script) -> None:
        super().__init__()
        self.post = script.deliveries.append
        self.post_loop_back = partial(setattr, script, "loop_back")

    def serve(self, ros: RosLoop) -> None:
        """Callbacks of a plugin are no part of a replay."""


class _ClosedTransport(MemoryTransport):
    """Carries nothing: the script decides which packets arrive, and when."""

    def open(self, inbox: Inbox) -> None:
        """Stay closed."""


class _Alone(LocalMiddleware):
    """The middleware of one node without neighbours."""

    def transport(self, file: NodeFile) -> MemoryTransport:
        super().transport(file)
        return _ClosedTransport(file, self.hub, NoTopics())

    def bridge(self, file: NodeFile) -> NoTopics:
        return NoTopics()


class ReplayedNode:
    """One node of a run.

    Attributes:
        comparison: of its packets with those of the run.
        failure: the error that ended it, ``None`` so far.
        notes: sentences for the user.
        difference: the first difference from the run, in a sentence; ``None`` so far.
    """

    def __init__(self, file: NodeFile, recorded: RecordedNode) -> None:
        file = replace(file, time=REAL)  # its clock is that of the event log
        self._file, self._recorded = file, recorded
        self._script = Script(recorded.event_log)
        self._loop = _Loop(self._script)
        self._middleware = _Alone(self._loop, None, on_failure=lambda _: None)
        lacking, sent = recorded.lacking(), recorded.sent()
        topics = {name for topics in sent.values() for name, _, _ in topics}
        may_lack = lacking if recorded.is_whole else topics
        self.comparison = Comparison(sent, recorded.message, may_lack)
        self.failure: NeurosError | None = None
        self.notes = [
            f"the bag has {there} of {sent} packets on {name}: the others are not compared"
            for name, (there, sent) in lacking.items()
        ]
        self.notes += filter(None, [recorded.callbacks])
        self.difference: str | None = None
        self._is_cut_off = False  # the replay ends before the event log does
        self._worlds: list[Advance] = []  # that run by themselves
        self._runtime = NodeRuntime(
            file,
            self._middleware,
            ContextSwitch(),
            tell=lambda _: None,
            fail=self._fail,
            recorder=self.comparison,
            log_file=None,
            duration_sim_s=None,
            make_engine=partial(ReplayedEngine, self._script),
            drive=self._drive,
        )
        self._types = {
            str(c): file.node.input(c.destination_input).type
            for c in file.connections
            if c.destination_node == file.node.name
        } | {port.name: port.type for port in file.node.inputs}

    @property
    def starts(self) -> int:
        return self._script.started

    @property
    def expects_start(self) -> bool:
        """Whether more hooks started in the run."""
        return self._script.expects_start

    @property
    def is_whole(self) -> bool:
        """Whether what was recorded reaches the end of the node."""
        return self._recorded.is_whole and not self._is_cut_off

    @property
    def has_outputs(self) -> bool:
        """Whether the node sends on a connection or external topic."""
        name = self._file.node.name
        is_sender = any(c.source_node == name for c in self._file.connections)
        return is_sender or any(port.external_topic for port in self._file.node.outputs)

    def run(self, around: Around) -> None:
        """Replay to the end of what was recorded, or the first difference."""
        try:
            self._runtime.load()
        except NeurosError as error:
            self._fail(self._file.node.name, error)
        if self.failure is None:
            around(self._play, self._runtime.specs)
        with suppress(KeyboardInterrupt):
            self._runtime.finalise()
        self._middleware.close()

    def packet(self, key: Connection | str, number: int) -> Any:
        """The ``number``-th packet that arrived on a connection or external topic."""
        data = self._recorded.arrived(key, number)
        if data is None:
            self.notes.append(
                f"the record ends before packet {number} that arrived on {key}: the replay ends"
                " there"
            )
            self._is_cut_off = True
            raise ReplayOver
        packet = RosPackets().decode(self._types[str(key)], data)
        if isinstance(key, Connection) and key.is_jpeg:
            from neuros.transport.jpeg import JpegCodec

            codec = JpegCodec(key.quality, Traffic())
            return codec.decode(codec.encode(packet))
        return packet

    def offer(self) -> None:
        """Give the engine packets of a world that runs by itself, or of a thread of the plugin."""
        if self._worlds:
            if len(self._worlds) > 1:
                raise ReplayParted(
                    f"{len(self._worlds)} worlds of the node run by themselves, and the run does"
                    " not tell which of them sent packets when"
                )
            packets: Mapping[str, Any] = {}
            try:
                while not packets:
                    packets = self._worlds[0]()
            except NeurosError as error:
                self._fail(self._file.node.name, error)
            else:
                self._engine.offer(packets, lambda: None)
            return
        self._engine.has_offer = False
        while not self._engine.has_offer:
            is_alone = threading.active_count() == 1
            if self._loop.step():
                continue
            if is_alone:
                raise ReplayParted(
                    "a thread of the plugin sent packets in the run, but no thread does in the"
                    " replay"
                )
            self._loop.wait(_POLL_S)

    def _drive(self, advance: Advance) -> bool:
        self._worlds.append(advance)
        return True

    @property
    def _engine(self) -> ReplayedEngine:
        engine: Engine | None = self._runtime.engine
        assert isinstance(engine, ReplayedEngine)
        return engine

    def _play(self) -> None:
        player = Player(self._script, self._engine, self._runtime, self)
        try:
            for event in self._script.events():
                player.play(event)
                if self.failure is not None or self.comparison.difference is not None:
                    break
            else:
                self._end()
        except ReplayOver:
            self._end()
        except ReplayParted as parted:
            self.difference = str(parted)
        if self.comparison.difference is not None:
            self.difference = self.comparison.difference

    def _end(self) -> None:
        """Judge the replay at the end of the event log."""
        if not self._recorded.is_whole:
            self.notes.append(
                f"the event log of the run ends after {self.starts} starts of hooks (the node was"
                " killed, or ran for very long): what it sent later is not compared"
            )
        elif self._is_cut_off:
            return
        elif self._script.expects_start:
            self.difference = (
                f"only {self.starts} hooks have started, and more did in the run: the next one is"
                " not ready here"
            )
        else:
            self.comparison.find_missing()

    def _fail(self, _: str, error: NeurosError) -> None:
        self.failure = error
        if not is_quit(error):
            self._runtime.failures.log(error)


def files_changed_since(run_folder: Path, file: NodeFile) -> list[Path]:
    """Python files in the folder of the plugin that were changed after the start of the run."""
    begun = (run_folder / "project.json").stat().st_mtime
    beside = sorted(file.node.plugin.parent.glob("*.py"))
    return [path for path in beside if path.stat().st_mtime > begun]


class Debugger:
    """Python's own debugger, at the start of every hook and after a failure."""

    def __init__(self) -> None:
        self._pdb = pdb.Pdb(nosigint=True, readrc=False)

    def run(self, action: Callable[[], None], functions: Iterable[Any]) -> None:
        """Run ``action`` with a breakpoint at the start of each of these functions."""
        for function in functions:
            code = function.__code__
            self._pdb.set_break(code.co_filename, code.co_firstlineno, funcname=code.co_name)
        self._pdb.rcLines = ["continue"]  # pdb would stop in NeuROS first
        self._pdb.runcall(action)

    def look_at(self, error: BaseException) -> None:
        """Open the debugger where an error was raised."""
        print(f"{type(error).__name__}: {error}")
        self._pdb.reset()
        self._pdb.interaction(None, error.__traceback__)


def is_quit(error: BaseException | None) -> bool:
    """Whether an error, or one of its causes, is the end of a debugger or Ctrl+C."""
    while error is not None:
        if isinstance(error, bdb.BdbQuit | KeyboardInterrupt):
            return True
        error = error.__cause__
    return False


@contextmanager
def debugpy_on(port: int | None) -> Iterator[None]:
    """Wait for an editor to attach, if a port is given.

    Raises:
        EnvironmentFault: if debugpy is not installed.
        UsageError: if the port cannot be used.
    """
    if port is not None:
        try:
            import debugpy
        except ImportError as error:
            raise EnvironmentFault(
                "--debugpy: debugpy is not installed for the Python of this node:"
                " pip install debugpy, or use --pdb"
            ) from error
        try:
            debugpy.listen((_DEBUGPY_HOST, port))
        except (RuntimeError, OSError) as error:
            raise UsageError(f"--debugpy {port}: {error}") from error
        print(f"waiting for a debugger to attach to {_DEBUGPY_HOST}:{port}", flush=True)
        debugpy.wait_for_client()
    yield
