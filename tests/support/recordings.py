"""Recordings made by hand: spools as nodes write them, and a plan for them; bags so far."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader

from neuros.recording.recorder import Recorder
from neuros.recording.recording_plan import RecordedStream, RecordingPlan, Topic
from neuros.recording.spool import NO_TIME, SpoolWriter

NUMBER = Topic("/neuros/a/number/b/number/data", "std_msgs/msg/Int32", True, 1, "a.number -> b.n")
ALSO = Topic("/neuros/a/number/c/number/data", "std_msgs/msg/Int32", False, 1, "a.number -> c.n")
ANSWER = Topic("/answer", "std_msgs/msg/Float64")


def plan(time_owner: str | None = None, flush_interval: float = 1.0) -> RecordingPlan:
    """Node a sends to b and c what is kept once; node b publishes on an external topic."""
    return RecordingPlan(
        topics=(NUMBER, ALSO, ANSWER),
        streams={
            "a": (RecordedStream("sent", "number", (0, 1)),),
            "b": (RecordedStream("sent", "answer", (2,)),),
        },
        time_owner=time_owner,
        custom={"run_id": "0123"},
        flush_interval=flush_interval,
    )


def number(value: int) -> bytes:
    """A ``std_msgs/msg/Int32``."""
    return b"\0\1\0\0" + value.to_bytes(4, "little", signed=True)


def answer(value: int = 0) -> bytes:
    """A ``std_msgs/msg/Float64`` with these bytes."""
    return b"\0\1\0\0" + value.to_bytes(8, "little")


def spool(run: Path, node: str, packets: Sequence[tuple[int, int | None, bytes]]) -> None:
    """Packets of stream 0 of a node: wall time, simulated time, content."""
    writer = SpoolWriter(run / node, ())
    for wall_ns, sim_ns, data in packets:
        writer.append(wall_ns, NO_TIME if sim_ns is None else sim_ns, 0, data)
    writer.close()


def record(run: Path, what: RecordingPlan) -> Recorder:
    """Move all that is in the spools into a bag."""
    what.save(run)
    recorder = Recorder(what, run, complain=fail)
    recorder.complete()
    recorder.clean_up()
    return recorder


def fail(text: str) -> None:
    """For recordings in which nothing may go wrong."""
    raise AssertionError(text)


def flushed(run: Path) -> Counter[str]:
    """How many packets of each topic mcap reads in a bag that is not complete."""
    counts: Counter[str] = Counter()
    with (
        contextlib.suppress(McapError, FileNotFoundError),
        (run / "bag/bag.mcap").open("rb") as file,
    ):
        for _, channel, _ in NonSeekingReader(file).iter_messages(log_time_order=False):
            counts[channel.topic] += 1
    return counts
