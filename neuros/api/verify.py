"""Comparison of two runs, packet by packet.

Packets are compared by the digests that nodes have kept, else by those of packets in bags.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from xxhash import xxh3_64_intdigest

from neuros.api.packets import Numbers, PacketLists, read_packets
from neuros.api.run_record import PastRun
from neuros.arithmetic import differences
from neuros.bag import Bag, RecordedTopic, open_bag
from neuros.errors import NeurosError
from neuros.recording.recording_plan import PLAN_NAME
from neuros.recording.stored import StoredBag

_LARGE_BYTES = 64 * 1024
"""From this size on, the buffers of a message travel beside it; nodes digest them apart."""


class RecordedPackets:
    """Bags of runs.

    Attributes:
        remarks: a sentence for each bag that could not be read.
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
        """Whether nodes compute the same digests: all messages are small, and travel whole."""
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
    """By topic, digests in the order of sending, and whether all packets are small."""
    times: dict[str, array[int]] = {}
    digests: dict[str, array[int]] = {}
    large: set[str] = set()
    for topic, log_ns, _, data, _ in StoredBag(bag.folder).messages(bag.refuse):
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
class RunComparison:
    """Result of a comparison.

    Attributes:
        difference: the first difference in time, in a sentence; ``None`` if there is none.
        remarks: differences that are allowed, and what could not be compared.
        compared: packets that were found equal.
        consumed_differently: connections with equal packets, of which hooks consumed others.
        not_compared: connections of which not all packets could be compared.
        likely_cause: for runs that differ, how processors and libraries of nodes did, in words;
            empty if they did not.
    """

    difference: str | None
    remarks: tuple[str, ...]
    compared: int
    consumed_differently: tuple[str, ...] = ()
    not_compared: tuple[str, ...] = ()
    likely_cause: str = ""


@dataclass(frozen=True)
class _Difference:
    """The first difference on one connection.

    Attributes:
        at_ns: when the packet was sent or consumed in run A.
        packet: the connection, and the number of the packet that differs, from 1.
    """

    at_ns: float
    text: str
    packet: tuple[str, int] | None = None


def compare(a: PastRun, b: PastRun, recorded: RecordedPackets) -> RunComparison:
    """Compare what was sent on every connection, and what hooks consumed.

    Where nodes have kept no digests, those of the bags of the runs are compared. Which packets
    hooks consume of a connection that may lose packets depends on timing: such a difference is
    only a remark. In virtual time it is none, and neither is one between the times at which packets
    were sent and hooks started.
    """
    comparer = _Comparer((a, b), recorded)
    for name in dict.fromkeys([*a.connections, *b.connections]):
        if name in a.connections and name in b.connections:
            comparer.compare(name)
        else:
            only = "A" if name in a.connections else "B"
            text = f"{name}: only run {only} has this connection"
            comparer.differences.append(_Difference(-1.0, text))
    comparer.compare_hooks()
    comparer.compare_values()
    return comparer.result()


def first_difference(
    a: PastRun, b: PastRun, counts: Mapping[str, int], recorded: RecordedPackets
) -> tuple[int, str]:
    """Compare the first packets of connections: how many, and in which one the runs differ first.

    Args:
        counts: by connection, how many packets to compare.
    """
    compared, differences = 0, []
    for name in (name for name in counts if name in a.connections and name in b.connections):
        in_a, in_b = (
            _between(each, 0, counts[name]) for each in packets_of_both(name, (a, b), recorded)
        )
        compared += _first_difference(in_a.sent, in_b.sent)
        found = _sent(name, in_a, in_b)
        if found is not None and not in_a.sent_before + in_b.sent_before:
            differences.append(found)
    if not differences:
        return compared, ""
    return compared, _told(min(differences, key=lambda each: each.at_ns), (a, b), recorded)


def _told(first: _Difference, runs: tuple[PastRun, PastRun], recorded: RecordedPackets) -> str:
    """A difference with the field in which it lies, if the runs were recorded."""
    if first.packet is None:
        return first.text
    messages = [recorded.message(run.folder, *first.packet) for run in runs]
    if None in messages:
        return f"{first.text} (to see in which field, run both with --record)"
    field = next(differing_fields(*messages), None)
    return first.text + (f" in {field}" if field else " (but no recorded field does)")


class _Comparer:
    """Compares two runs, connection by connection."""

    def __init__(self, runs: tuple[PastRun, PastRun], recorded: RecordedPackets) -> None:
        self._runs = runs
        self._recorded = recorded
        self.differences: list[_Difference] = []
        self._remarks: list[str] = []
        self._consumed_differently: list[str] = []
        self._not_compared: list[str] = []
        self._compared = 0
        self._is_virtual = all("virtual_s" in run.record for run in runs)

    def result(self) -> RunComparison:
        text, cause = None, ""
        if self.differences:
            first = min(self.differences, key=lambda difference: difference.at_ns)
            others = len(self.differences) - 1
            if others:
                differ = "connections differ" if others > 1 else "connection differs"
                self._remarks.append(f"{others} more {differ}, from a later moment on")
            text = _told(first, self._runs, self._recorded)
            records = [run.record for run in self._runs]
            cause = differences(*(record.get("arithmetic") or {} for record in records))
            if cause and not all(record.get("is_portable") for record in records):
                cause += " (run both with --portable)"
        return RunComparison(
            text,
            tuple(self._remarks),
            self._compared,
            tuple(self._consumed_differently),
            tuple(self._not_compared),
            cause,
        )

    def compare(self, name: str) -> None:
        """Compare the packets of a connection that both runs have."""
        both = packets_of_both(name, self._runs, self._recorded)
        counts = [run.connections[name]["sent"] for run in self._runs]
        lacking = [
            str(run.folder)
            for run, count, packets in zip(self._runs, counts, both, strict=True)
            if _lacks_digests(count, packets)
        ]
        if lacking:
            self._not_compared.append(name)
            self._remarks.append(
                f"{name}: not compared, since {' and '.join(dict.fromkeys(lacking))} has"
                " neither digests nor a recording of it (the in-process back end keeps digests with"
                " --digests, and none are kept with --packet-log 0; packets from a node to itself"
                " never have any: record them with -r)"
            )
            return
        start = max(packets.sent_before for packets in both)
        ends = [packets.sent_before + len(packets.sent) for packets in both]
        cut_off = [end for count, end in zip(counts, ends, strict=True) if (count or 0) > end]
        in_a, in_b = both
        if start or cut_off:
            end = max(start, min(cut_off)) if cut_off else None
            in_a, in_b = (_between(packets, start, end) for packets in both)
            if start:
                self._remarks.append(
                    f"{name}: compared from packet {start + 1} on; the first {start} are not kept"
                    " (--packet-log), nor is it compared what hooks took"
                )
            if cut_off:
                self._remarks.append(
                    f"{name}: compared up to packet {end}; later packets have no digests"
                )
        self._compared += _first_difference(in_a.sent, in_b.sent)
        consumed = None
        if cut_off or in_a.before or in_b.before:
            self._not_compared.append(name)
        else:
            consumed = _consumed(name, in_a, in_b)
        taken = [run.connections[name].get("consumed") for run in self._runs]
        if consumed is None and None not in taken and taken[0] != taken[1]:  # no list tells it
            text = f"{name}: hooks took {taken[0]} packets in run A, and {taken[1]} in run B"
            consumed = _Difference(np.inf, text)
        sent = _sent(name, in_a, in_b)
        is_lossless = self._runs[0].connections[name]["discard_limit"] == 0
        timed = _timed(name, in_a, in_b) if self._is_virtual else None
        if sent is not None:
            self.differences.append(sent)
        elif consumed is not None and (is_lossless or self._is_virtual):
            self.differences.append(consumed)
        elif timed is not None:
            self.differences.append(timed)
        elif consumed is not None:
            self._consumed_differently.append(name)
            self._remarks.append(f"{consumed.text}: this connection may lose packets")

    def compare_hooks(self) -> None:
        """Compare how often hooks started in virtual time, and how long they took."""
        a, b = (run.nodes for run in self._runs)
        for node in [name for name in a if name in b] if self._is_virtual else ():
            hooks = [nodes[node].get("hooks", {}) for nodes in (a, b)]
            for hook in dict.fromkeys([*hooks[0], *hooks[1]]):
                figures = [
                    (each.get(hook, {}).get("executions", 0), each.get(hook, {}).get("busy_s", 0.0))
                    for each in hooks
                ]
                if figures[0] != figures[1]:
                    a_text, b_text = (f"{n} times, for {s:.9g} s" for n, s in figures)
                    text = f"hook '{hook}' of {node} ran {a_text} in run A, and {b_text} in run B"
                    self.differences.append(_Difference(np.inf, text))

    def compare_values(self) -> None:
        """Compare the files of what plugins keep, and of what was restored to them."""
        a, b = (run.nodes for run in self._runs)
        for node in [name for name in a if name in b]:
            for how in ("restored", "kept"):
                one, other = (nodes[node].get(how, {}) for nodes in (a, b))
                for name in dict.fromkeys([*one, *other]):
                    hashes = [values.get(name, {}).get("sha256") for values in (one, other)]
                    if hashes[0] != hashes[1]:
                        self._remarks.append(f"{node}.{name}: another value was {how} in run B")


def packets_of_both(
    name: str, runs: tuple[PastRun, PastRun], recorded: RecordedPackets
) -> tuple[PacketLists, PacketLists]:
    """The lists of both runs, with digests from their bags where nodes have kept none.

    If both runs have a bag, and one of them no digests of nodes, both digests are of bags. Digests
    of a bag are compared with those of nodes only if all messages are small.
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
            # On a reliable connection all packets arrive.
            received = bag if runs[0].ends[name].is_reliable else packets[place].received
            packets[place] = replace(packets[place], sent=bag, received=received, sent_before=0)
    return packets[0], packets[1]


def _lacks_digests(sent: int | None, packets: PacketLists) -> bool:
    """Whether packets were sent, or may have been, of which no digest is known."""
    if sent is None:  # by a node of another launcher, or by one that never reported
        return not len(packets.sent) and not len(packets.received)
    return sent > 0 and not len(packets.sent)


def _between(packets: PacketLists, start: int, end: int | None) -> PacketLists:
    """The packets sent from ``start`` up to before ``end``, counted from 0."""
    first = start - packets.sent_before
    count = None if end is None else first + end - start
    return replace(
        packets,
        sent=packets.sent[first:count],
        sent_ns=packets.sent_ns[first:count],
        sent_before=min(start, packets.sent_before + len(packets.sent)),
    )


def _sent(name: str, in_a: PacketLists, in_b: PacketLists) -> _Difference | None:
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


def _consumed(name: str, in_a: PacketLists, in_b: PacketLists) -> _Difference | None:
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


def _timed(name: str, in_a: PacketLists, in_b: PacketLists) -> _Difference | None:
    """The first packet that was sent, or that a hook started on, at another virtual time."""
    for what, a, b in (
        ("packet {} was sent", in_a.sent_ns, in_b.sent_ns),
        ("the hook of start {} started", in_a.taken_ns, in_b.taken_ns),
    ):
        place = _first_difference(a, b)
        if place < min(len(a), len(b)):
            times = f"at {a[place] / 1e9:.9g} s in run A, and at {b[place] / 1e9:.9g} s in run B"
            text = f"{name}: {what.format(place + 1)} {times}"
            return _Difference(float(a[place]), text)
    return None


def _first_difference(a: Numbers, b: Numbers) -> int:
    """The first place at which the numbers differ, from 0; at the latest the end of the shorter."""
    common = min(len(a), len(b))
    unequal = np.flatnonzero(a[:common] != b[:common])
    return int(unequal[0]) if len(unequal) else common


def differing_fields(
    a: Any, b: Any, name: str = "", sides: tuple[str, str] = ("A", "B")
) -> Iterator[str]:
    """Differences between two messages of one type: ``header.stamp.sec: 3 in A, 4 in B``."""
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
    if not (a == b or (a != a and b != b)):  # NaN equals NaN here
        left, right = _plain(a), _plain(b)
        yield f"{name}: {left!r} in {sides[0]}, {right!r} in {sides[1]}"


def _plain(value: Any) -> Any:
    """A number of NumPy as one of Python, whose ``repr`` does not show the type."""
    return value.item() if isinstance(value, np.generic) else value
