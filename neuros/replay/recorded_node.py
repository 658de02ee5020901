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
from neuros.engine.event_log import is_understood
from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import Way
from neuros.project.model import Connection, NodeFile
from neuros.project.scanner import read_bytes
from neuros.recording.recording_plan import RecordingPlan, load_plan
from neuros.recording.run_file import read_node_file

_RECORD = "run the project again with -r (--record), and replay that run"


def recorded_node(run_folder: Path, name: str) -> tuple[PastRun, NodeFile]:
    """A run, and ``node.json`` of one of its nodes, with the paths that the node saw.

    Raises:
        UsageError: if the run or the node does not exist, or the recording is not enough for a
            replay.
        EnvironmentFault: if a file of the run is damaged.
    """
    run = open_run(run_folder)
    if name not in run.nodes:
        names = ", ".join(run.nodes)
        raise UsageError(f"replay: {run_folder} has no node '{name}'; it has {names}")
    load_plan(run_folder)
    if not _event_log_of(run_folder, name).is_file():
        raise UsageError(
            f"replay: {run_folder} does not tell in which order '{name}' received its packets:"
            f" {_RECORD}"
        )
    try:
        return run, read_node_file(run_folder / name)
    except OSError as error:
        raise EnvironmentFault(
            f"replay: {error.filename} cannot be read ({error.strerror})"
        ) from error


class RecordedNode:
    """The packets of one node, from the bag of a run.

    Attributes:
        event_log: events of its engine (:mod:`neuros.engine.event_log`).
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
        self._arrivals: dict[Connection | str, Sequence[bytes | None]] = {}
        recorded = {name for topic in self.plan.topics for name in (topic.connection, topic.name)}
        inputs = [
            *(
                str(c)
                for c in file.connections
                if c.destination_node == self._name != c.source_node
            ),
            *(self._topic(port.name) for port in file.node.inputs if port.external_topic),
        ]
        if missing := [name for name in inputs if name not in recorded]:
            raise UsageError(
                f"replay: what '{self._name}' received on {', '.join(missing)} was not recorded:"
                f" {_RECORD}"
            )

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
        """A message of a type that the bag has."""
        return self._bag.message(data, type_name)

    def _packets(self, topic: str) -> Sequence[Any]:
        return self._bag.topics[topic].raw() if topic in self._bag.topics else ()

    def _received(self, connection: Connection) -> Sequence[bytes | None]:
        packets = [packet.data for packet in self._packets(f"{connection.topic}/data")]
        if connection.is_reliable or self._keeps(Way.RECEIVED, str(connection)):
            return packets
        digests = read_packets(self._run.folder, connection)
        places = {digest: place for place, digest in enumerate(digests.sent.tolist())}
        received = digests.received.tolist()
        figures = self._run.connections.get(str(connection), {})
        if len(places) < (figures.get("sent") or 0):  # the list was full
            received = [*takewhile(places.__contains__, received)]
        if not received or any(digest not in places for digest in received):
            raise UsageError(
                f"replay: {connection} may lose packets, and {self._run.folder} does not tell which"
                f" of them arrived: {_RECORD} (with --packet-log 0, no run tells)"
            )
        arrived = (places[digest] for digest in received)
        return [packets[place] if place < len(packets) else None for place in arrived]

    def _from_outside(self, name: str) -> Sequence[bytes]:
        """Only the first node that listens to an external topic records what arrives."""
        topic = self._topic(name)
        if not self._keeps(Way.HEARD, name):
            raise UsageError(
                f"replay: another node has recorded {topic}, so it is not known which packets"
                f" reached '{self._name}'"
            )
        return [packet.data for packet in self._packets(topic)]

    def _topic(self, name: str) -> str:
        """The external topic of an input."""
        topic = self._file.node.input(name).external_topic or ""
        return self._file.names.resolve(topic, self._name)

    def _keeps(self, way: Way, name: str) -> bool:
        streams = self.plan.streams.get(self._name, ())
        return any((stream.way, stream.name) == (way.value, name) for stream in streams)


def _event_log_of(run_folder: Path, name: str) -> Path:
    return run_folder / name / FOLDER / "event_log"
