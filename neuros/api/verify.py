"""Comparison of two runs, packet by packet.

Packets are compared by the lists of nodes, and where nodes have kept no digests, from bags.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from xxhash import xxh3_64_intdigest

from neuros.api.packets import Numbers, Packets, read_packets
from neuros.api.run_record import PastRun
from neuros.bag import Bag, RecordedTopic, open_bag
from neuros.errors import NeurosError
from neuros.recording.recording_plan import PLAN_NAME
from neuros.recording.stored import stored_messages

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
        topic, bag = self._topic(run, connection), self._bags[run]
        if topic is None or bag is None:
            return None
        if run not in self._digests:
            self._digests[run] = _digests(bag)
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
            bag = open_bag(run)
        except NeurosError as error:
            self.remarks.append(str(error))
            return None
        self.remarks += [bag.damage] if bag.damage else []
        return bag


def _digests(bag: Bag) -> dict[str, tuple[Numbers, bool]]:
    """By topic, digests in the order in which packets were sent, and whether all are small."""
    times: dict[str, array[int]] = {}
    digests: dict[str, array[int]] = {}
    large: set[str] = set()
    for topic, log_ns, _, data, _ in stored_messages(bag.folder, bag.refuse):
        times.setdefault(topic, array("q")).append(log_ns)
        padded = data + bytes(-len(data) % 4)
        digests.setdefault(topic, array("Q")).append(xxh3_64_intdigest(padded))
        if len(data) >= _LARGE_BYTES:
            large.add(topic)
    for name in bag.topics:
        bag.expect(name, len(times.get(name, ())))
    found = {}
    for topic, at_ns in times.items():
        order = np.argsort(np.frombuffer(at_ns, np.int64), kind="stable")
        found[topic] = np.frombuffer(digests[topic], np.uint64)[order], topic not in large
    return found


@dataclass(frozen=True)
class Verdict:
    """Result of a comparison.

    Attributes:
        difference: where the runs parted first, in a sentence; ``None`` if they are identical.
        remarks: what differs and may, and what could not be compared.
        compared: packets that were found equal.
        consumed_differently: connections that carried the same packets, of which hooks took others.
        not_compared: connections of which not all packets could be compared.
    """

    difference: str | None
    remarks: tuple[str, ...]
    compared: int
    consumed_differently: tuple[str, ...] = ()
    not_compared: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Difference:
    """One connection on which they part; ``at_ns`` (in run A) tells which was the first.

    ``packet``: the connection and the number of the first packet that differs, from 1.
    """

    at_ns: float
    text: str
    packet: tuple[str, int] | None = None


def compare(a: PastRun, b: PastRun, recorded: RecordedPackets) -> Verdict:
    """Compare what was sent on every connection, and what hooks took of it.

    Where nodes have kept no digests, packets are taken from the bags of the runs. Of connections
    that may lose packets it depends on the moment which ones hooks get: that is told apart.
    """
    found: list[_Difference] = []
    remarks: list[str] = []
    differing: list[str] = []
    incomplete: list[str] = []
    compared = 0
    names = [*a.connections, *(name for name in b.connections if name not in a.connections)]
    for name in names:
        if name not in a.connections or name not in b.connections:
            only = "A" if name in a.connections else "B"
            found.append(_Difference(-1.0, f"{name}: only run {only} has this connection"))
            continue
        compared += _compare_connection(
            name, (a, b), recorded, found, remarks, differing, incomplete
        )
    first = min(found, key=lambda difference: difference.at_ns, default=None)
    others = len(found) - 1
    if others > 0:
        differ = "connections differ" if others > 1 else "connection differs"
        remarks.append(f"{others} more {differ}, from a later moment on")
    text = None if first is None else first.text
    if first is not None and first.packet is not None:  # a bag is read for the first one only
        text = f"{first.text} {_field((a.folder, b.folder), *first.packet, recorded)}"
    return Verdict(text, tuple(remarks), compared, tuple(differing), tuple(incomplete))


def _compare_connection(
    name: str,
    runs: tuple[PastRun, PastRun],
    recorded: RecordedPackets,
    found: list[_Difference],
    remarks: list[str],
    differing: list[str],
    incomplete: list[str],
) -> int:
    """Returns how many packets were found equal; adds to the four lists."""
    a, b = runs
    in_a, in_b = _packets(name, runs, recorded)
    sent = [(run.connections[name]["sent"], p) for run, p in ((a, in_a), (b, in_b))]
    lacking = [_lacks_digests(*each) for each in sent]
    if any(lacking):
        incomplete.append(name)
        folders = [run.folder for run, lacks in zip(runs, lacking, strict=True) if lacks]
        remarks.append(
            f"{name}: not compared, since {' and '.join(dict.fromkeys(map(str, folders)))} has"
            " neither digests nor a recording of it (the in-process back end keeps digests with"
            " --digests, and none are kept with --packet-log 0; packets from a node to itself never"
            " have any: record them with -r)"
        )
        return 0
    both = in_a, in_b
    start = max(packets.sent_before for packets in both)
    ends = [packets.sent_before + len(packets.sent) for packets in both]
    cut_off = [end for (count, _), end in zip(sent, ends, strict=True) if (count or 0) > end]
    if start or cut_off:
        end = max(start, min(cut_off)) if cut_off else None
        in_a, in_b = (_between(packets, start, end) for packets in both)
        if start:
            remarks.append(
                f"{name}: compared from packet {start + 1} on; the first {start} are not kept"
                " (--packet-log), nor is it compared what hooks took"
            )
        if cut_off:
            remarks.append(f"{name}: compared up to packet {end}; later packets have no digests")
    compared = _first_difference(in_a.sent, in_b.sent)
    if cut_off or in_a.before or in_b.before:
        incomplete.append(name)
        taken = _counted(name, runs)
    else:
        taken = _taken(name, in_a, in_b) or _counted(name, runs)
    difference = _sent(name, in_a, in_b)
    if difference is not None:
        found.append(difference)
    elif taken is not None and a.connections[name]["discard_limit"] == 0:
        found.append(taken)
    elif taken is not None:
        differing.append(name)
        remarks.append(f"{taken.text}: this connection may lose packets")
    return compared


def _packets(
    name: str, runs: tuple[PastRun, PastRun], recorded: RecordedPackets
) -> tuple[Packets, Packets]:
    """The lists of both runs, with digests from their bags where nodes have kept none.

    If one run has digests of its nodes and the other only a bag, both are taken from bags, where
    both have one; a bag stands beside digests of nodes only where both digest packets alike.
    """
    packets = [read_packets(run.folder, run.ends[name]) for run in runs]
    lacks = [
        _lacks_digests(run.connections[name]["sent"], listed)
        for run, listed in zip(runs, packets, strict=True)
    ]
    if not any(lacks):
        return packets[0], packets[1]
    bags = [recorded.digests(run.folder, name) for run in runs]
    have_both = all(bag is not None for bag in bags)
    for place, (run, bag) in enumerate(zip(runs, bags, strict=True)):
        stands_beside = lacks[place] and recorded.are_as_of_nodes(run.folder, name)
        if bag is not None and (have_both or stands_beside):
            # On a reliable connection all of it arrives.
            received = bag if runs[0].ends[name].is_reliable else packets[place].received
            packets[place] = replace(packets[place], sent=bag, received=received, sent_before=0)
    return packets[0], packets[1]


def _lacks_digests(sent: int | None, packets: Packets) -> bool:
    """Whether packets have passed, or may have, of which nothing is known here."""
    if sent is None:  # by a node of another launcher, or one that never reported
        return not len(packets.sent) and not len(packets.received)
    return sent > 0 and not len(packets.sent)


def _between(packets: Packets, start: int, end: int | None) -> Packets:
    """Without what was sent before, or from ``end`` on; both count from 0."""
    first = start - packets.sent_before
    count = None if end is None else first + end - start
    return replace(
        packets,
        sent=packets.sent[first:count],
        sent_ns=packets.sent_ns[first:count],
        sent_before=min(start, packets.sent_before + len(packets.sent)),
    )


def _sent(name: str, in_a: Packets, in_b: Packets) -> _Difference | None:
    place = _first_difference(in_a.sent, in_b.sent)
    if place == len(in_a.sent) == len(in_b.sent):
        return None
    at_ns = float(in_a.sent_ns[place]) if place < len(in_a.sent_ns) else np.inf
    number = in_a.sent_before + place
    if place == len(in_a.sent) or place == len(in_b.sent):
        ends = [each.sent_before + len(each.sent) for each in (in_a, in_b)]
        shorter, longer = ("A", "B") if ends[0] < ends[1] else ("B", "A")
        text = f"{name}: run {shorter} ends after packet {min(ends)}, run {longer} has more"
        return _Difference(at_ns, f"{text} ({max(ends) - min(ends)})")
    return _Difference(at_ns, f"{name}: packet {number + 1} differs", (name, number + 1))


def _field(folders: tuple[Path, Path], name: str, number: int, recorded: RecordedPackets) -> str:
    """In which field a packet differs, as far as it was recorded."""
    messages = [recorded.message(folder, name, number) for folder in folders]
    if None in messages:
        return "(to see in which field, run both with --record)"
    field = next(differing_fields(*messages), None)
    return f"in {field}" if field else "(but no recorded field does)"


def _taken(name: str, in_a: Packets, in_b: Packets) -> _Difference | None:
    a, b = in_a.consumed, in_b.consumed
    place = _first_difference(a, b)
    if place == len(a) == len(b):
        return None
    at_ns = float(in_a.consumed_ns[place]) if place < len(a) else np.inf
    if place in (len(a), len(b)):
        what = f"hooks took {len(a)} packets in run A, and {len(b)} in run B"
    else:
        what = f"hooks took different packets as number {place + 1}"
    return _Difference(at_ns, f"{name}: {what}")


def _counted(name: str, runs: tuple[PastRun, PastRun]) -> _Difference | None:
    """What the counters of both runs say where there are no lists of what hooks took."""
    a, b = (run.connections[name].get("consumed") for run in runs)
    if a is None or b is None or a == b:
        return None
    return _Difference(np.inf, f"{name}: hooks took {a} packets in run A, and {b} in run B")


def _first_difference(a: Numbers, b: Numbers) -> int:
    """The first place at which they differ, from 0; where one ends, at the latest."""
    common = min(len(a), len(b))
    unequal = np.flatnonzero(a[:common] != b[:common])
    return int(unequal[0]) if len(unequal) else common


def differing_fields(
    a: Any, b: Any, name: str = "", sides: tuple[str, str] = ("A", "B")
) -> Iterator[str]:
    """Differences between two messages of a type: ``header.stamp.sec: 3 in A, 4 in B``."""
    fields = getattr(a, "__dataclass_fields__", None)
    if fields:
        for field in fields:
            if not field.startswith("__"):
                inner = f"{name}.{field}" if name else field
                yield from differing_fields(getattr(a, field), getattr(b, field), inner, sides)
        return
    if isinstance(a, np.ndarray | list | tuple) and not isinstance(b, str):
        if len(a) != len(b):
            yield f"{name}: {len(a)} elements in {sides[0]}, {len(b)} in {sides[1]}"
            return
        for place, (left, right) in enumerate(zip(a, b, strict=True)):
            yield from differing_fields(left, right, f"{name}[{place}]", sides)
        return
    if not (a == b or (a != a and b != b)):  # NaN is what it was
        left, right = _plain(a), _plain(b)
        yield f"{name}: {left!r} in {sides[0]}, {right!r} in {sides[1]}"


def _plain(value: Any) -> Any:
    """A number of NumPy as Python's own, which is shown without its type."""
    return value.item() if isinstance(value, np.generic) else value
