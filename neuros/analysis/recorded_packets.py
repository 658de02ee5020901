"""Packets of runs from their bags, for comparisons: one by one, and as digests."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from xxhash import xxh3_64_intdigest

from neuros.analysis.packets import Numbers
from neuros.errors import NeurosError
from neuros.recording.bag_files import stored_messages
from neuros.recording.bag_reader import Bag, RecordedTopic, open_bag
from neuros.recording.recording_plan import PLAN_NAME

_LARGE_BYTES = 64 * 1024
"""The buffers of larger messages travel beside them, and nodes digest them apart."""


class RecordedPackets:
    """Bags of runs.

    Attributes:
        remarks: why a bag could not be read, a sentence each.
    """

    def __init__(self) -> None:
        self.remarks: list[str] = []
        self._bags: dict[Path, Bag | None] = {}
        self._digests: dict[Path, Mapping[str, tuple[Numbers, bool]]] = {}

    def message(self, run: Path, connection: str, number: int) -> Any:
        """A packet of a connection by its number, from 1; ``None`` if it was not recorded."""
        topic = self._topic(run, connection)
        return topic.message(number - 1) if topic and number <= topic.count else None

    def digests(self, run: Path, connection: str) -> Numbers | None:
        """A digest of each packet that was sent; ``None`` if the connection was not recorded."""
        found = self._digests_of(run, connection)
        return None if found is None else found[0]

    def are_as_of_nodes(self, run: Path, connection: str) -> bool:
        """Whether nodes digest them alike: small messages, which travel whole."""
        found = self._digests_of(run, connection)
        return found is not None and found[1]

    def _digests_of(self, run: Path, connection: str) -> tuple[Numbers, bool] | None:
        topic = self._topic(run, connection)
        if topic is None:
            return None
        if run not in self._digests:
            self._digests[run] = _digests(self._bags[run])
        nothing = np.array([], np.uint64), True
        return self._digests[run].get(topic.name, nothing)

    def _topic(self, run: Path, connection: str) -> RecordedTopic | None:
        if run not in self._bags:
            self._bags[run] = self._open(run)
        bag = self._bags[run]
        topics = () if bag is None else bag.topics.values()
        return next((topic for topic in topics if topic.connection == connection), None)

    def _open(self, run: Path) -> Bag | None:
        if not (run / PLAN_NAME).exists():
            return None
        try:
            return open_bag(run)
        except NeurosError as error:
            self.remarks.append(str(error))
            return None


def _digests(bag: Bag | None) -> dict[str, tuple[Numbers, bool]]:
    """By topic, digests in the order in which packets were sent, and whether all are small."""
    times: dict[str, array[int]] = {}
    digests: dict[str, array[int]] = {}
    large: set[str] = set()
    for topic, log_ns, _, data in stored_messages(bag.folder) if bag else ():
        times.setdefault(topic, array("q")).append(log_ns)
        padded = data + bytes(-len(data) % 4)
        digests.setdefault(topic, array("Q")).append(xxh3_64_intdigest(padded))
        if len(data) >= _LARGE_BYTES:
            large.add(topic)
    found = {}
    for topic, at_ns in times.items():
        order = np.argsort(np.frombuffer(at_ns, np.int64), kind="stable")
        found[topic] = np.frombuffer(digests[topic], np.uint64)[order], topic not in large
    return found
