"""Packet lists of a run, as :mod:`neuros.node.logs` writes them: times, digests, latencies.

Times are of the monotonic clock of the machine, which all its processes share. If the ends of a
connection were on different machines, their lists are in different run folders, and it has no
latency.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128_hexdigest

from neuros.ordinary_files import open_ordinary
from neuros.project.model import Connection

_COUNT = re.compile(r"[1-9][0-9]{0,17}")
FOLDER = "packets"
PERCENTILES = (50, 90, 99)

Numbers = NDArray[Any]


@dataclass(frozen=True)
class PacketLists:
    """The lists of one connection; empty where there are none.

    Attributes:
        sent_ns: when each packet was sent, (sent,).
        sent: its digest, (sent,).
        received: the digest of each packet that arrived, (received,).
        taken: for each start of a hook, the place of its packet in ``received``, from 1, (taken,).
        taken_ns: when the hook started, (taken,).
        pauses_ns: start and end of each pause of the receiver, (pauses, 2).
        damaged: files that are left out from an impossible entry on.
        sent_before, received_before, taken_before: how many entries in front of the lists the node
            has not kept.
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
        """How many of the first packets some list lacks; 0: all lists are complete at the start."""
        return max(self.sent_before, self.received_before, self.taken_before)

    @property
    def consumed(self) -> Numbers:
        """The digests of the packets that hooks have started on, each once, in order, (n,)."""
        places = np.unique(self.taken) - self.received_before
        found: Numbers = self.received[places[_is_in(self.received, places)] - 1]
        return found

    @property
    def consumed_ns(self) -> Numbers:
        """When the first hook has started on each packet of :attr:`consumed`, (n,)."""
        places, firsts = np.unique(self.taken, return_index=True)
        is_known = _is_in(self.received, places - self.received_before)
        found: Numbers = self.taken_ns[firsts[is_known]]
        return found

    def flights_ns(self, *, may_lose: bool) -> Numbers | None:
        """For each start of a hook, when its packet was sent and when it started, (starts, 2).

        Args:
            may_lose: whether packets may be lost on their way. Those that arrived are then found
                among the sent ones by their digests; ``None`` if that is not possible.
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
        """Nanoseconds from sending a packet to each start of a hook on it, without pauses.

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
        """For each packet that arrived, its place in ``sent``, from 0; ``None`` if unknown.

        Without the first ones that arrived, if the sender has not kept their digests.
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


def read_packets(run_folder: Path, connection: Connection) -> PacketLists:
    """Read the lists of a connection; a killed node has not written the newest entries."""
    index = connection.index
    sender = node_folder(run_folder, connection.source_node) / FOLDER
    receiver = node_folder(run_folder, connection.destination_node) / FOLDER
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
    return PacketLists(
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
    """Lists of the same packets, from the first packet that all of them have."""
    before = max((before for before, numbers in lists if len(numbers)), default=0)
    return before, [numbers[before - its_before :] for its_before, numbers in lists]


def _list(file: Path, kind: Any) -> tuple[int, Numbers]:
    """How many entries of a list were not kept, and the kept ones, up to a missing file."""
    found, end = [numbers_of(file, kind)], 0
    before = 0
    if not len(found[0]):  # the first file was removed, or never written
        names = (
            each.name.removeprefix(f"{file.name}.") for each in file.parent.glob(f"{file.name}.*")
        )
        before = min((int(name) for name in names if _COUNT.fullmatch(name)), default=0)
    end = before + len(found[0])
    while end and len(more := numbers_of(file.with_name(f"{file.name}.{end}"), kind)):
        found.append(more)
        end += len(more)
    return before, found[0] if len(found) == 1 else np.concatenate(found)


def node_folder(run_folder: Path, node: str) -> Path:
    """The folder of a node in a run folder, or in one that holds those of the parts of a run."""
    own = run_folder / node
    if (own / "node.json").exists():
        return own
    return next(run_folder.glob(f"*/{node}"), own)


def packet_figures(packets: PacketLists, *, may_lose: bool) -> dict[str, Any]:
    """Latency and digests of a connection, ready for JSON.

    ``latency_ms`` is ``None`` where it is not known, ``digests`` where those of all packets, or of
    the first ones, were not kept.
    """
    latency_ms: dict[str, float] | None = None
    latencies_ns = packets.latencies_ns(may_lose=may_lose)
    if latencies_ns is not None and len(latencies_ns):
        percentiles = np.percentile(latencies_ns, PERCENTILES) / 1e6
        latency_ms = {
            **{f"p{p}": float(ms) for p, ms in zip(PERCENTILES, percentiles, strict=True)},
            "max": float(latencies_ns.max()) / 1e6,
            "count": len(latencies_ns),
        }
    digests: dict[str, Any] | None = None
    if (len(packets.sent) or len(packets.received)) and not packets.before:
        consumed = packets.consumed
        digests = {
            "sent": xxh3_128_hexdigest(packets.sent.tobytes()),
            "sent_packets": len(packets.sent),
            "consumed": xxh3_128_hexdigest(consumed.tobytes()),
            "consumed_packets": len(consumed),
        }
    return {"latency_ms": latency_ms, "digests": digests}


def may_have_lost(figures: Mapping[str, Any]) -> bool:
    """Whether a connection, from ``run.json``, may have lost packets on their way."""
    is_best_effort = figures.get("discard_limit") is None
    return is_best_effort and figures.get("sent") != figures.get("received")


def _is_in(numbers: Numbers, places: Numbers) -> Numbers:
    found: Numbers = (places >= 1) & (places <= len(numbers))
    return found


def up_to_first(wrong: Numbers) -> int:
    """The number of rows in front of the first wrong one."""
    return int(np.argmax(wrong)) if wrong.any() else len(wrong)


def numbers_of(file: Path, kind: Any, columns: int = 1) -> Numbers:
    """The complete rows of 64-bit numbers in a file, (rows, columns), or (rows,) of one column.

    They are mapped: of the lists of a long run, those that nobody reads take no memory.
    """
    data: mmap.mmap | bytes
    try:
        with open_ordinary(file) as content:
            data = mmap.mmap(content.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):  # the node has sent or received nothing
        data = b""
    found = np.frombuffer(data, dtype=kind, count=len(data) // (8 * columns) * columns)
    return found if columns == 1 else found.reshape(-1, columns)
