"""Repair of the bag of a run that was cut off, from its file and from the spools."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from neuros.errors import EnvironmentFault, UsageError
from neuros.recording.recorder import Recorder, has_spools
from neuros.recording.recording_plan import (
    BAG_NAME,
    LISTENER,
    PLAN_NAME,
    RecordingPlan,
    load_plan,
)
from neuros.recording.run_file import read_run_file
from neuros.recording.spool import SpoolReader, listened_topics
from neuros.recording.stored import is_whole, opened, stored_messages

DAMAGED_NAME = "bag.damaged"
KEPT_NAME = "bag.before_repair"


@contextlib.contextmanager
def the_only_recorder(run: Path) -> Iterator[bool]:
    """Whether no other process writes the bag of a run, now and within the block."""
    descriptor = os.open(run / PLAN_NAME, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
            return
        yield True
    finally:
        os.close(descriptor)


def needs_repair(run: Path, plan: RecordingPlan) -> bool:
    """Whether the bag of a run that has ended is not complete."""
    bag = run / BAG_NAME
    return (run / DAMAGED_NAME).exists() or not is_whole(bag) or has_spools(run, [*plan.streams])


@dataclass(frozen=True)
class Repaired:
    """What came of a repair.

    Attributes:
        counts: by topic, the packets in the bag.
        changed: how many packets may have changed, since the checksum of their part was wrong.
    """

    counts: dict[str, int]
    changed: int


def repair(
    run: Path, complain: Callable[[str], object], *, keeps_changed: bool = False
) -> Repaired | None:
    """Complete the bag of a run; ``None`` if it is complete.

    Args:
        complain: told in one sentence of each part that is damaged.
        keeps_changed: keep packets that may have changed; else they are left out.

    Raises:
        UsageError: if the run was not recorded, or by another version.
        EnvironmentFault: if it is still being recorded, or cannot be written.
    """
    plan = load_plan(run)
    try:
        with the_only_recorder(run) as is_alone:
            if not is_alone or _is_fed(run, plan):
                raise EnvironmentFault(f"{run} is still being recorded: wait for its end")
            is_to_be_rebuilt = needs_repair(run, plan) or _has_damage(run / BAG_NAME)
            if not is_to_be_rebuilt:
                return None
            return _rebuild(run, plan, complain, keeps_changed=keeps_changed)
    except OSError as error:
        raise EnvironmentFault(
            f"the bag of {run} cannot be completed: {error.strerror}; what is there was left as it"
            " is"
        ) from error


def recorded_counts(run: Path) -> dict[str, int]:
    """By topic, the packets that were in the bag when the run ended, as far as is known."""
    try:
        topics = read_run_file(run)["recording"]["topics"]
        return {name: int(topic["recorded"]) for name, topic in topics.items()}
    except (UsageError, EnvironmentFault, KeyError):
        return {}


def counts_of(run: Path) -> dict[str, int]:
    """Packets in the bag of a run, by topic. Raises ``OSError`` if it cannot be read."""
    try:
        with opened(run / BAG_NAME) as reader:
            return {connection.topic: connection.msgcount for connection in reader.connections}
    except EnvironmentFault as error:
        raise OSError(errno.EIO, str(error)) from error


def _has_damage(bag: Path) -> bool:
    """Whether a part of a file is not as it was written; reads all of it."""
    faults: list[str] = []
    for _ in stored_messages(bag, faults.append):
        if faults:
            break
    return bool(faults)


def _is_fed(run: Path, plan: RecordingPlan) -> bool:
    """Whether a node of the run goes on, though its recorder does not."""
    return any(SpoolReader(run / name).is_fed for name in (*plan.streams, LISTENER))


def _rebuild(
    run: Path, plan: RecordingPlan, complain: Callable[[str], object], *, keeps_changed: bool
) -> Repaired:
    bag, damaged = run / BAG_NAME, run / DAMAGED_NAME
    if not damaged.exists():
        if bag.exists():
            bag.rename(damaged)
    elif bag.exists():  # a repair that did not come to its end
        shutil.rmtree(bag)
    topics = {topic.name: topic for topic in (*plan.topics, *listened_topics(run))}
    present: set[tuple[int, int]] = set()
    faults: list[str] = []
    changed = 0

    def note(fault: str) -> None:
        faults.append(fault)
        complain(fault)

    recorder = Recorder(plan, run, complain, lambda topic, wall_ns: (topic, wall_ns) not in present)
    try:
        for message in stored_messages(damaged, note):
            if message.may_have_changed:
                changed += 1
                if not keeps_changed:
                    continue
            topic = topics.get(message.topic)
            number = None if topic is None else recorder.copy(topic, message)
            if number is not None:
                present.add((number, message.log_ns))
        recorder.complete()
    except BaseException:
        recorder.abandon()
        raise
    counts = recorder.counts()
    is_less = any(counts.get(name, 0) < count for name, count in recorded_counts(run).items())
    # In this order: cut off in between, the next repair finds all that is not in the bag.
    if damaged.exists():
        kept = run / KEPT_NAME
        if (faults or is_less) and not kept.exists():
            damaged.rename(kept)
            complain(f"the damaged bag is kept in {kept}")
        else:
            shutil.rmtree(damaged)
    recorder.clean_up()
    return Repaired(counts, changed)
