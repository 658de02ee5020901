"""Recorder: moves packets from the spools of a run into its bag, ordered by wall time.

In virtual time, all times in spools and bag are virtual. Nodes do not come to a time together, and
packets of a slow one are written late, with the simulated time of their own moment.

The bag of a run that was cut off is repaired from its file and from the spools.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import time
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import TypeAlias

from neuros.errors import EnvironmentFault, UsageError
from neuros.ordinary_files import reason_of
from neuros.project.scanner import read_bytes
from neuros.recording.bag_writer import BagWriter
from neuros.recording.recording_plan import (
    BAG_NAME,
    RecordingPlan,
    Topic,
    load_plan,
)
from neuros.recording.run_file import read_run_file
from neuros.recording.spool import (
    NO_TIME,
    ForwardClock,
    SpoolReader,
    SpoolRecord,
)
from neuros.recording.stored import StoredBag, faults_of, is_whole

# A packet is in its spool this long after its time, unless its process was kept from running.
# Readers of bags sort, so a packet that comes later does no harm.
_SPOOLING_NS = 20_000_000
_MOST_BYTES = 8 << 20
_MOST_HELD = 64 << 20  # bytes of packets that wait in virtual time for simulated time
_ALL_NS = (1 << 63) - 1

_Kept: TypeAlias = "tuple[int, int, tuple[int, ...], bytes, bool]"
_IsNew: TypeAlias = Callable[[int, int], bool]
Arrived: TypeAlias = "tuple[Topic, int, bytes]"
DAMAGED_NAME = "bag.damaged"
KEPT_NAME = "bag.before_repair"


class Recorder:
    """Writes the bag of a run.

    Args:
        run: the run folder.
        complain: receives each problem, a sentence.
        is_new: whether the bag lacks the packet of a topic, by its number, at a wall time.
        arrived: topic, wall time and content of packets that no node sees, from another thread.
        clock: monotonic, in seconds; tells when a flush is due.

    Raises:
        OSError: if the bag cannot be made.
    """

    def __init__(
        self,
        plan: RecordingPlan,
        run: Path,
        complain: Callable[[str], object],
        is_new: _IsNew | None = None,
        arrived: SimpleQueue[Arrived] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._plan = plan
        self._run = run
        self._complain = complain
        self._is_new = is_new
        self._arrived: SimpleQueue[Arrived] = arrived or SimpleQueue()
        self._clock = clock
        self.bag = BagWriter(run / BAG_NAME, plan.custom)
        self.topics: dict[Topic, int | None] = {}
        for topic in plan.topics:
            self.number_of(topic)
        self._sources = [
            _SpoolSource(
                SpoolReader(run / node),
                [
                    self._numbers(plan.topics[place] for place in stream.topics)
                    for stream in streams
                ],
                owns_time=node == plan.time_owner,
            )
            for node, streams in plan.streams.items()
        ]
        self._held: list[_Kept] = []
        self._written_ns = 0
        self._wall_clock = ForwardClock()
        # When the node that owns time has sent, and simulated time then; in real time the last one.
        self._sent_ns, self._sim_ns = array("q", [-1]), array("q", [0])
        self._is_flushed = True
        self._due_s = self._clock() + plan.flush_interval

    def number_of(self, topic: Topic) -> int | None:
        """The number of a topic in the bag, ``None`` if it cannot be recorded."""
        if topic not in self.topics:
            try:
                self.topics[topic] = self.bag.add_topic(topic)
            except EnvironmentFault as error:
                self.topics[topic] = None
                self._complain(f"{topic.name} is not recorded: {error}")
        return self.topics[topic]

    def poll(self) -> bool:
        """Move packets; returns whether the spools have more now. Raises ``OSError``."""
        has_more = self._move(self._wall_clock() - _SPOOLING_NS)
        if not self._is_flushed and self._clock() >= self._due_s:
            self._due_s = self._clock() + self._plan.flush_interval
            self.bag.flush()
            self._is_flushed = True
            # All that was read is in the bag, but for what is held.
            safe_ns = self._held[0][0] - 1 if self._held else _ALL_NS
            for source in self._sources:
                if not source.is_damaged:
                    source.reader.remove_up_to(safe_ns)
        return has_more

    @property
    def is_fed(self) -> bool:
        """Whether a process still has a spool open for writing."""
        return any(source.reader.is_fed for source in self._sources)

    def complete(self) -> None:
        """Move all that is left, and close the bag. Raises ``OSError``."""
        while self._move(None):
            pass
        self.bag.close()

    def clean_up(self) -> None:
        """Remove the spools, whose packets are in the bag."""
        for source in self._sources:
            source.reader.close(remove=not source.is_damaged)

    def abandon(self) -> None:
        """Stop, and leave bag and spools unfinished."""
        self.bag.shut()
        for source in self._sources:
            source.reader.close(remove=False)

    def counts(self) -> dict[str, int]:
        """Packets in the bag, by topic."""
        found: dict[str, int] = {}
        for topic, number in self.topics.items():
            count = 0 if number is None else self.bag.counts[number]
            found[topic.name] = found.get(topic.name, 0) + count
        return found

    # ------------------------------------------------------------------ inside

    def _move(self, horizon_ns: int | None) -> bool:
        """Write packets up to ``horizon_ns`` (``None``: all); returns whether a spool has more."""
        has_more = False
        for source in self._sources:
            records, is_capped = self._read(source)
            self._held += [
                (record.wall_ns, record.sim_ns, topics, record.data, source.owns_time)
                for record in records
                if (topics := self._topics_of(record, source)) is not None
            ]
            if is_capped and records:
                has_more = True
                last_ns = records[-1].wall_ns
                horizon_ns = last_ns if horizon_ns is None else min(horizon_ns, last_ns)
        while not self._arrived.empty():
            topic, wall_ns, data = self._arrived.get()
            if topic not in self._plan.topics:  # a repair of the bag has to know it
                self._plan = replace(self._plan, topics=(*self._plan.topics, topic))
                self._plan.save(self._run)
            time_ns = self._written_ns if self._plan.is_virtual else wall_ns
            self._held.append((time_ns, NO_TIME, self._numbers([topic]), data, False))
        self._held.sort(key=lambda kept: (kept[0], not kept[4]))
        if self._plan.is_virtual and horizon_ns is not None:
            horizon_ns = self._virtual_horizon_ns()
        written = 0
        for kept in self._held:
            if horizon_ns is not None and kept[0] > horizon_ns:
                break
            self._write(*kept)
            written += 1
        del self._held[:written]
        self._is_flushed = self._is_flushed and not written
        return has_more

    def _virtual_horizon_ns(self) -> int:
        """Up to when simulated time is known for each moment of virtual time."""
        if self._plan.time_owner is None or sum(len(kept[3]) for kept in self._held) > _MOST_HELD:
            return _ALL_NS
        return max((kept[0] for kept in self._held if kept[4]), default=self._sent_ns[-1]) - 1

    def _read(self, source: _SpoolSource) -> tuple[list[SpoolRecord], bool]:
        """Records of a spool, and whether it has more; none once it has failed."""
        if source.has_failed:
            return [], False
        try:
            records, is_capped = source.reader.read(_MOST_BYTES)
            if source.reader.is_damaged:
                self._complain_of(source)
            return records, is_capped
        except OSError as error:
            source.has_failed = source.is_damaged = True
            self._complain(
                f"{reason_of(error)}: packets in {source.reader} are not recorded, and it is kept"
            )
            return [], False

    def _topics_of(self, record: SpoolRecord, source: _SpoolSource) -> tuple[int, ...] | None:
        """The numbers of its topics; ``None`` if the record is damaged."""
        if record.stream < len(source.topics) and record.wall_ns >= 0 and record.sim_ns >= NO_TIME:
            return source.topics[record.stream]
        self._complain_of(source)
        return None

    def _complain_of(self, source: _SpoolSource) -> None:
        if not source.is_damaged:
            source.is_damaged = True
            self._complain(
                f"{source.reader} is damaged: packets in it are not recorded, and it is kept"
            )

    def _write(
        self, wall_ns: int, sim_ns: int, topics: tuple[int, ...], data: bytes, owns_time: bool
    ) -> None:
        publish_ns = wall_ns
        self._written_ns = max(self._written_ns, wall_ns)
        if sim_ns != NO_TIME:
            publish_ns = sim_ns
            if owns_time:
                if not self._plan.is_virtual:
                    del self._sent_ns[:], self._sim_ns[:]
                self._sent_ns.append(wall_ns)
                self._sim_ns.append(sim_ns)
        elif self._plan.time_owner is not None:
            publish_ns = self._sim_ns[max(0, bisect_right(self._sent_ns, wall_ns) - 1)]
        for topic in topics:
            if self._is_new is None or self._is_new(topic, wall_ns):
                self.bag.put(topic, wall_ns, publish_ns, data)

    def _numbers(self, topics: Iterable[Topic]) -> tuple[int, ...]:
        numbers = (self.number_of(topic) for topic in topics)
        return tuple(number for number in numbers if number is not None)


@dataclass
class _SpoolSource:
    """A spool, and the numbers of the topics of each of its streams.

    Attributes:
        is_damaged: whether a part was not recorded; the spool is kept then.
        has_failed: whether reading it has failed.
    """

    reader: SpoolReader
    topics: list[tuple[int, ...]]
    owns_time: bool
    is_damaged: bool = False
    has_failed: bool = False


@contextlib.contextmanager
def the_only_recorder(run: Path) -> Iterator[bool]:
    """Lock the bag of a run within the block; yields whether no other process writes it."""
    folder = os.open(run, os.O_RDONLY | os.O_DIRECTORY)
    try:
        is_alone = False
        with contextlib.suppress(OSError):
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_alone = True
        yield is_alone
    finally:
        os.close(folder)


def needs_repair(run: Path, plan: RecordingPlan) -> bool:
    """Whether the bag of a run that has ended is not complete."""
    if (run / DAMAGED_NAME).exists() or not is_whole(run / BAG_NAME):
        return True
    try:
        return any(SpoolReader(run / name).has_files for name in plan.streams)
    except OSError:
        return True  # the repair tells the reason


@dataclass(frozen=True)
class Repaired:
    """Result of a repair.

    Attributes:
        counts: by topic, the packets in the bag.
        changed: how many packets are in parts with a wrong checksum.
        lost: by topic, how many packets the bag has lost since the run ended.
    """

    counts: dict[str, int]
    changed: int
    lost: dict[str, int]


def repair(
    run: Path, complain: Callable[[str], object], *, keeps_changed: bool = False
) -> Repaired | None:
    """Complete the bag of a run; ``None`` if it is complete.

    Args:
        complain: receives a sentence for each damaged part.
        keeps_changed: whether to keep packets in parts with a wrong checksum.

    Raises:
        UsageError: if the run was not recorded, or was recorded by another version.
        EnvironmentFault: if it is still being recorded, or cannot be written.
    """
    plan = load_plan(run)
    try:
        with the_only_recorder(run) as is_alone:
            # A node may go on though its recorder does not.
            spools = (SpoolReader(run / name) for name in plan.streams)
            if not is_alone or any(spool.is_fed for spool in spools):
                raise EnvironmentFault(f"{run} is still being recorded: wait for its end")
            if not needs_repair(run, plan) and not faults_of(
                StoredBag(run / BAG_NAME), counts_of(run)
            ):
                return None
            return _rebuild(run, plan, complain, keeps_changed=keeps_changed)
    except OSError as error:
        raise EnvironmentFault(
            f"the bag of {run} cannot be completed: {reason_of(error)}; what is there was left as"
            " it is"
        ) from error


def recorded_counts(run: Path) -> dict[str, int]:
    """By topic, the packets that the bag had when the run ended, or when it was last written.

    Empty if neither ``run.json`` nor the metadata of the bag tell.
    """
    with contextlib.suppress(UsageError, EnvironmentFault, KeyError):
        topics = read_run_file(run)["recording"]["topics"]
        return {name: int(topic["recorded"]) for name, topic in topics.items()}
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        information = json.loads(read_bytes(run / BAG_NAME / "metadata.yaml"))
        topics = information["rosbag2_bagfile_information"]["topics_with_message_count"]
        return {topic["topic_metadata"]["name"]: int(topic["message_count"]) for topic in topics}
    return {}


def lost_of(recorded: Mapping[str, int], there: Mapping[str, int]) -> dict[str, int]:
    """By topic, how many of the recorded packets are not there."""
    lost = {name: count - there.get(name, 0) for name, count in recorded.items()}
    return {name: count for name, count in lost.items() if count > 0}


def named(lost: Mapping[str, int]) -> str:
    """Missing packets in words."""
    return ", ".join(f"{count} of {name}" for name, count in lost.items())


def counts_of(run: Path) -> dict[str, int]:
    """Packets in the bag of a run, by topic. Raises ``OSError`` if it cannot be read."""
    try:
        topics = StoredBag(run / BAG_NAME).contents().connections.values()
        return {each.topic: each.msgcount for each in topics}
    except EnvironmentFault as error:
        raise OSError(errno.EIO, str(error)) from error


def _rebuild(
    run: Path, plan: RecordingPlan, complain: Callable[[str], object], *, keeps_changed: bool
) -> Repaired:
    topics = {topic.name: topic for topic in plan.topics}
    bag, damaged, recorded = run / BAG_NAME, run / DAMAGED_NAME, recorded_counts(run)
    for folder in (bag, damaged):
        if folder.is_symlink():
            what = "it is a link: put the folder itself in its place, or remove it"
            raise OSError(errno.ENOTDIR, what, str(folder))
    if not damaged.exists():
        if bag.exists():
            bag.rename(damaged)
    elif bag.exists():  # left by a repair that was interrupted
        shutil.rmtree(bag)
    present: set[tuple[int, int]] = set()
    faults: list[str] = []
    changed = 0

    def add_fault(fault: str) -> None:
        faults.append(fault)
        complain(fault)

    recorder = Recorder(plan, run, complain, lambda topic, wall_ns: (topic, wall_ns) not in present)
    try:
        for message in StoredBag(damaged).messages(add_fault) if damaged.exists() else ():
            if message.may_have_changed:
                changed += 1
                if not keeps_changed:
                    continue
            topic = topics.get(message.topic)
            number = None if topic is None else recorder.number_of(topic)
            if number is not None:
                recorder.bag.put(number, message.log_ns, message.publish_ns, message.data)
                present.add((number, message.log_ns))
        recorder.complete()
    except BaseException:
        recorder.abandon()
        if damaged.exists():
            shutil.rmtree(bag)
            damaged.rename(bag)
        raise
    counts = recorder.counts()
    lost = lost_of(recorded, counts)
    # The spools go last: if this is interrupted, the next repair finds all packets.
    if damaged.exists():
        kept = run / KEPT_NAME
        if (faults or lost) and not kept.exists():
            damaged.rename(kept)
            complain(f"the damaged bag is kept in {kept}")
        else:
            shutil.rmtree(damaged)
    recorder.clean_up()
    return Repaired(counts, changed, lost)
