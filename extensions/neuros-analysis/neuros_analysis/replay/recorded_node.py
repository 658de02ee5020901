"""Packets that one node of a recorded run has received and sent."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from neuros.api.packets import FOLDER, read_packets
from neuros.api.run_record import PastRun, open_run
from neuros.bag import Bag, open_bag
from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import Way
from neuros.project.model import Connection, NodeFile
from neuros.project.scanner import read_bytes
from neuros.project.suggest import counted, did_you_mean
from neuros.recording.recorder import repair
from neuros.recording.recording_plan import RecordingPlan, load_plan
from neuros.recording.run_file import read_node_file
from neuros_analysis.replay.script import callbacks_in, is_understood, is_whole

_RECORD = "run the project again with -r (--record), and replay that run"


def recorded_run(run_folder: Path) -> PastRun:
    """A run that was recorded; of one whose launcher was killed, what the recording says of it.

    Raises:
        UsageError: if the run does not exist, or was not recorded.
        EnvironmentFault: if a file of the run is damaged.
    """
    try:
        run = open_run(run_folder)
    except UsageError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        custom = load_plan(run_folder).custom
        if "file" not in custom:  # an earlier version wrote it
            raise
        names = [file.parent.name for file in sorted(run_folder.glob("*/node.json"))]
        kept = {key: custom[key] for key in ("project", "file", "backend")}
        nodes: dict[str, Any] = {name: {} for name in names}
        return PastRun(run_folder, {**kept, "exit_code": 1, "reason": "", "nodes": nodes})
    load_plan(run_folder)
    return run


def require_end(run: PastRun) -> None:
    """Complete the bag of a run whose launcher was killed.

    Raises:
        EnvironmentFault: if the run goes on.
    """
    if is_cut_off(run):
        repair(run.folder, lambda _: None)


def is_cut_off(run: PastRun) -> bool:
    """Whether the launcher has left no record of the run, since it was killed."""
    return "format" not in run.record


def recorded_node(run: PastRun, name: str) -> NodeFile:
    """``node.json`` of a node of a run, with the paths that the node saw.

    Raises:
        UsageError: if the node does not exist, or the recording is not enough for a replay.
        EnvironmentFault: if a file of the run is damaged.
    """
    run_folder = run.folder
    if name not in run.nodes:
        hint = did_you_mean(name, run.nodes) or f"it has {', '.join(run.nodes)}"
        raise UsageError(f"replay: {run_folder} has no node '{name}' ({hint})")
    if not _event_log_of(run_folder, name).is_file():
        raise UsageError(
            f"replay: {run_folder} does not tell in which order '{name}' received its packets:"
            f" {_RECORD}"
        )
    try:
        return read_node_file(run_folder / name)
    except OSError as error:
        raise EnvironmentFault(
            f"replay: {error.filename} cannot be read ({error.strerror})"
        ) from error


class RecordedNode:
    """The packets of one node, from the bag of a run.

    Attributes:
        event_log: events of its engine (:mod:`neuros_analysis.replay.script`).
        is_whole: whether these reach the end of the node.
        plan: of the recording.

    Raises:
        UsageError: if the run was not recorded, or packets for the node were left out.
        EnvironmentFault: if the bag is damaged.
    """

    def __init__(self, run: PastRun, file: NodeFile) -> None:
        self._run, self._file = run, file
        self._name = file.node.name
        self.plan: RecordingPlan = load_plan(run.folder)
        self._bag: Bag = open_bag(run.folder)
        self.event_log: array[int] = array("q")
        data = read_bytes(_event_log_of(run.folder, self._name))
        self.event_log.frombytes(data[: len(data) // 8 * 8])
        if not is_understood(self.event_log):
            raise EnvironmentFault(f"{_event_log_of(run.folder, self._name)} is damaged")
        self.is_whole = is_whole(self.event_log)
        self._arrivals: dict[Connection | str, Sequence[bytes | None]] = {}
        recorded = {name for topic in self.plan.topics for name in (topic.connection, topic.name)}
        self._incoming = [
            c for c in file.connections if c.destination_node == self._name != c.source_node
        ]
        self._external = [port.name for port in file.node.inputs if port.external_topic]
        inputs = [*map(str, self._incoming), *map(self._topic, self._external)]
        if missing := [name for name in inputs if name not in recorded]:
            raise UsageError(
                f"replay: what '{self._name}' received on {', '.join(missing)} was not recorded:"
                f" {_RECORD}"
            )

    def check(self) -> None:
        """Check that all can be compared, as far as it is known before the replay.

        Raises:
            UsageError: if it is not known what the node received, or nothing of what it sent; for
                callbacks that no replay can call.
        """
        for connection in self._incoming:
            self._which_arrived(connection)
        for name in self._external:
            self._require_own(name)
        if self.callbacks:
            raise UsageError(
                f"replay: {self.callbacks}: receive by an input with external_topic, and wait by a"
                " tick"
            )
        sends = [str(c) for c in self._file.connections if c.source_node == self._name]
        sends += [port.name for port in self._file.node.outputs if port.external_topic]
        if sends and not self.sent():
            raise UsageError(f"replay: nothing that it sent was recorded: {_RECORD}")

    @property
    def callbacks(self) -> str:
        """What a replay cannot repeat of the ROS node of the plugin; empty if there is nothing."""
        count = callbacks_in(self.event_log)
        of = "of services, timers or subscriptions on its ROS node ran, which a replay cannot call"
        return f"{counted(count, 'callback')} {of}" if count else ""

    def arrived(self, key: Connection | str, number: int) -> bytes | None:
        """The ``number``-th packet, from 1, that arrived; ``None`` if the bag ends before it.

        Args:
            key: the connection, or the input with an external topic.

        Raises:
            UsageError: if the run does not tell which packets arrived.
        """
        if key not in self._arrivals:
            self._arrivals[key] = (
                self._from_outside(key) if isinstance(key, str) else self._received(key)
            )
        arrivals = self._arrivals[key]
        return arrivals[number - 1] if number <= len(arrivals) else None

    def sent(self) -> dict[tuple[Way, str], list[tuple[str, str, Sequence[Any]]]]:
        """Packets that the node has sent, by way and by port or connection.

        Each value is a list of topics: name (that of the connection, if any), type and packets.
        """
        found: dict[tuple[Way, str], list[tuple[str, str, Sequence[Any]]]] = {}
        for stream in self.plan.streams.get(self._name, ()):
            way = Way(stream.way)
            if way not in (Way.SENT, Way.TO_ITSELF):
                continue
            topics = [self.plan.topics[place] for place in stream.topics]
            found[way, stream.name] = [
                (topic.connection or topic.name, topic.type, self._packets(topic.name))
                for topic in topics
            ]
        return found

    def lacking(self) -> dict[str, tuple[int, int]]:
        """Connections of which the bag lacks packets: how many packets it has, of how many."""
        found = {}
        for topics in self.sent().values():
            for name, _, packets in topics:
                sent = self._run.connections.get(name, {}).get("sent") or 0
                if len(packets) < sent:
                    found[name] = len(packets), sent
        return found

    def message(self, data: bytes, type_name: str) -> Any:
        return self._bag.message(data, type_name)

    def _packets(self, topic: str) -> Sequence[Any]:
        return self._bag.topics[topic].raw() if topic in self._bag.topics else ()

    def _received(self, connection: Connection) -> Sequence[bytes | None]:
        packets = [packet.data for packet in self._packets(f"{connection.topic}/data")]
        places = self._which_arrived(connection)
        if places is None:
            return packets
        return [packets[place] if place < len(packets) else None for place in places]

    def _which_arrived(self, connection: Connection) -> Sequence[int] | None:
        """The places of the packets that arrived, from 0, of those sent; ``None``: all of them."""
        if connection.is_reliable or self._keeps(Way.RECEIVED, str(connection)):
            return None
        digests = read_packets(self._run.folder, connection)
        places = {digest: place for place, digest in enumerate(digests.sent.tolist())}
        received = digests.received.tolist()
        figures = self._run.connections.get(str(connection), {})
        sent = figures.get("sent")
        if sent is None or len(places) < sent:  # a list ends early: it was full, or a kill cut it
            received = [*takewhile(places.__contains__, received)]
        is_known = received or figures.get("received") == 0 or not self.is_whole
        if not is_known or any(digest not in places for digest in received):
            raise UsageError(
                f"replay: {connection} may lose packets, and {self._run.folder} does not tell which"
                f" of them arrived: {_RECORD} (with --packet-log 0, no run tells)"
            )
        return [places[digest] for digest in received]

    def _from_outside(self, name: str) -> Sequence[bytes]:
        self._require_own(name)
        return [packet.data for packet in self._packets(self._topic(name))]

    def _require_own(self, name: str) -> None:
        """Only the first node that listens to an external topic records what arrives."""
        if not self._keeps(Way.HEARD, name):
            raise UsageError(
                f"replay: another node has recorded {self._topic(name)}, so it is not known which"
                f" packets reached '{self._name}'"
            )

    def _topic(self, name: str) -> str:
        topic = self._file.node.input(name).external_topic or ""
        return self._file.names.resolve(topic, self._name)

    def _keeps(self, way: Way, name: str) -> bool:
        streams = self.plan.streams.get(self._name, ())
        return any((stream.way, stream.name) == (way.value, name) for stream in streams)


def _event_log_of(run_folder: Path, name: str) -> Path:
    return run_folder / name / FOLDER / "event_log"
