"""Lists that nodes of a run have written: times, digests and latencies of packets.

Reads what :mod:`neuros.node.logs` writes. Both ends' times are of the monotonic clock
of one machine, which all its processes share; the two ends of a connection on different machines
leave their lists in different run folders, and no latency is worked out for them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128_hexdigest

from neuros.project.model import Connection
from neuros.project.scanner import read_bytes

_COUNT = re.compile(r"[1-9][0-9]{0,17}")
FOLDER = "packets"
PERCENTILES = (50, 90, 99)

Numbers = NDArray[Any]


@dataclass(frozen=True)
class Packets:
    """The lists of one connection; empty where there are none.

    Attributes:
        sent_ns: when each packet was sent, (sent,).
        sent: its digest, (sent,).
        received: the digest of each that arrived, (received,).
        taken: of each that a hook started on, its place among those that arrived, from 1, (taken,).
        taken_ns: when that was, (taken,).
        pauses_ns: when the receiver stood still, start and end of each pause, (pauses, 2).
        damaged: files of which the rest is left out, from an entry that no node has written.
        sent_before, received_before, taken_before: how many entries the node has not kept, which
            came before the first ones here.
    """

    sent_ns: Numbers
    sent: Numbers
    received: Numbers
    taken: Numbers
    taken_ns: Numbers
    pauses_ns: Numbers = field(default_factory=lambda: np.empty((0, 2), np.int64))
    damaged: tuple[Path, ...] = ()
    sent_before: int = 0
    received_before: int = 0
    taken_before: int = 0

    @property
    def before(self) -> int:
        """How many of the first packets some list has not kept; 0: all lists are from the start."""
        return max(self.sent_before, self.received_before, self.taken_before)

    @property
    def consumed(self) -> Numbers:
        """The digests of the packets that hooks have started on, each once, in order."""
        places = np.unique(self.taken) - self.received_before
        found: Numbers = self.received[places[_is_in(self.received, places)] - 1]
        return found

    @property
    def consumed_ns(self) -> Numbers:
        """When the first hook has started on each packet of :attr:`consumed`."""
        places, firsts = np.unique(self.taken, return_index=True)
        is_known = _is_in(self.received, places - self.received_before)
        found: Numbers = self.taken_ns[firsts[is_known]]
        return found

    def flights_ns(self, *, may_lose: bool) -> Numbers | None:
        """When a packet was sent, and when a hook started on it: for each start, (starts, 2).

        Where packets may be lost on their way, those that arrived are found by their digests among
        those that were sent; ``None`` if that is not possible.
        """
        places, before = self.taken, self.sent_before
        sent_ns, taken_ns = self.sent_ns, self.taken_ns
        if may_lose:
            which = self._which_arrived()
            if which is None:
                return None
            before = self.received_before + len(self.received) - len(which)
            sent_ns = sent_ns[which]
        is_known = _is_in(sent_ns, places - before)
        return np.column_stack([sent_ns[places[is_known] - before - 1], taken_ns[is_known]])

    def latencies_ns(self, *, may_lose: bool) -> Numbers | None:
        """Nanoseconds from when a packet was sent to each start of a hook on it, without pauses.

        ``None`` as from :meth:`flights_ns`.
        """
        flights_ns = self.flights_ns(may_lose=may_lose)
        if flights_ns is None:
            return None
        latencies_ns: Numbers = np.diff(flights_ns).ravel()
        if len(self.pauses_ns):
            edges = self.pauses_ns.ravel()
            paused_ns = np.repeat(np.cumsum(np.diff(self.pauses_ns).ravel()), 2)
            paused_ns[::2] -= np.diff(self.pauses_ns).ravel()  # up to the start of each pause
            latencies_ns = latencies_ns - np.diff(np.interp(flights_ns, edges, paused_ns)).ravel()
        return latencies_ns

    def _which_arrived(self) -> Numbers | None:
        """For each packet that arrived, its place among those that were sent, from 0.

        The first ones that arrived are left out where their sender has not kept them.
        """
        order = np.argsort(self.sent)
        ordered = self.sent[order]
        if len(ordered) != len(self.sent_ns) or (ordered[1:] == ordered[:-1]).any():
            return None
        found = np.searchsorted(ordered, self.received)
        is_known = found < len(ordered)
        found[~is_known] = 0
        if not len(ordered):
            return None
        is_known &= ordered[found] == self.received
        first = int(np.argmax(is_known)) if self.sent_before else 0
        if not is_known[first:].all():
            return None
        return order[found[first:]]


def read_packets(run_folder: Path, connection: Connection) -> Packets:
    """The lists of a connection; what a killed node could not write any more is missing."""
    index = connection.index
    sender = _node_folder(run_folder, connection.source_node) / FOLDER
    receiver = _node_folder(run_folder, connection.destination_node) / FOLDER
    taken_before, (taken, taken_ns) = _beside(
        _list(receiver / f"{index}.taken", np.int64),
        _list(receiver / f"{index}.taken_ns", np.int64),
    )
    both = min(len(taken), len(taken_ns))
    good = up_to_first(taken[:both] < 1)
    damaged = () if good == both else (receiver / f"{index}.taken",)
    sent_before, (sent_ns, sent) = _beside(
        _list(sender / f"{index}.sent_ns", np.int64), _list(sender / f"{index}.digests", np.uint64)
    )
    received_before, received = _list(receiver / f"{index}.digests", np.uint64)
    return Packets(
        sent_ns=sent_ns,
        sent=sent,
        received=received,
        taken=taken[:good],
        taken_ns=taken_ns[:good],
        pauses_ns=numbers_of(receiver / "pauses", np.int64, 2),
        damaged=damaged,
        sent_before=sent_before,
        received_before=received_before,
        taken_before=taken_before,
    )


def _beside(*lists: tuple[int, Numbers]) -> tuple[int, list[Numbers]]:
    """Lists of the same packets from the first one that all have; not all need be kept."""
    before = max((before for before, numbers in lists if len(numbers)), default=0)
    return before, [numbers[before - its_before :] for its_before, numbers in lists]


def _list(file: Path, kind: Any) -> tuple[int, Numbers]:
    """How many entries of a list were not kept, and the others; of files without a gap."""
    found, end = [numbers_of(file, kind)], 0
    before = 0
    if not len(found[0]):  # it has gone, or there never was one
        names = (
            each.name.removeprefix(f"{file.name}.") for each in file.parent.glob(f"{file.name}.*")
        )
        before = min((int(name) for name in names if _COUNT.fullmatch(name)), default=0)
    end = before + len(found[0])
    while end and len(more := numbers_of(file.with_name(f"{file.name}.{end}"), kind)):
        found.append(more)
        end += len(more)
    return before, found[0] if len(found) == 1 else np.concatenate(found)


def _node_folder(run_folder: Path, node: str) -> Path:
    """The folder of a node in a run folder, or in one that holds those of the parts of a run."""
    own = run_folder / node
    if (own / "node.json").exists():
        return own
    return next(run_folder.glob(f"*/{node}"), own)


def packet_figures(packets: Packets, *, may_lose: bool) -> dict[str, Any]:
    """Latency and digests of a connection, ready for JSON.

    ``latency_ms`` is ``None`` where it cannot be told, ``digests`` where none were kept, or not
    those of the first packets.
    """
    return {"latency_ms": _latency_ms(packets, may_lose), "digests": _digests(packets)}


def _latency_ms(packets: Packets, may_lose: bool) -> dict[str, float] | None:
    latencies_ns = packets.latencies_ns(may_lose=may_lose)
    if latencies_ns is None or not len(latencies_ns):
        return None
    percentiles = np.percentile(latencies_ns, PERCENTILES) / 1e6
    return {
        **{f"p{p}": float(ms) for p, ms in zip(PERCENTILES, percentiles, strict=True)},
        "max": float(latencies_ns.max()) / 1e6,
        "count": len(latencies_ns),
    }


def _digests(packets: Packets) -> dict[str, Any] | None:
    if not (len(packets.sent) or len(packets.received)) or packets.before:
        return None
    consumed = packets.consumed
    return {
        "sent": xxh3_128_hexdigest(packets.sent.tobytes()),
        "sent_packets": len(packets.sent),
        "consumed": xxh3_128_hexdigest(consumed.tobytes()),
        "consumed_packets": len(consumed),
    }


def may_have_lost(figures: Mapping[str, Any]) -> bool:
    """Whether packets of a connection, from ``run.json``, may have been lost on their way."""
    is_best_effort = figures.get("discard_limit") is None
    return is_best_effort and figures.get("sent") != figures.get("received")


def _is_in(numbers: Numbers, places: Numbers) -> Numbers:
    """Which places, from 1, are of one of the numbers."""
    found: Numbers = (places >= 1) & (places <= len(numbers))
    return found


def up_to_first(wrong: Numbers) -> int:
    """The number of rows in front of the first wrong one."""
    return int(np.argmax(wrong)) if wrong.any() else len(wrong)


def numbers_of(file: Path, kind: Any, columns: int = 1) -> Numbers:
    """All complete rows; one number in each makes an array of one dimension."""
    try:
        data = read_bytes(file)
    except OSError:  # the node has sent, or received, nothing
        data = b""
    found = np.frombuffer(data[: len(data) // (8 * columns) * 8 * columns], dtype=kind)
    return found if columns == 1 else found.reshape(-1, columns)
