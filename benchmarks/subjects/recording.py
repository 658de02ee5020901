"""What a recording costs a run, and how much one recorder keeps up with."""

from __future__ import annotations

import functools
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import flooding
from benchmarks.in_turn import speed_with
from benchmarks.measure import MINIMUM_PAIRS, Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import IMU_PACKET, LARGE, Packet
from benchmarks.subjects.whiskeye import WHISKEYE
from neuros.backends.sidecars import RecorderProcess
from neuros.recording.recorder import Recorder
from neuros.recording.recording_plan import RecordedStream, RecordingPlan, Topic
from neuros.recording.spool import SpoolWriter

RECORD = ("-r",)
SIMULATED_S = 100.0
SLICE_S = 0.5  # the recorder writes what was kept 0.1 s before
PROJECTS = {"hybrid": "project", "strict": "strict"}
IMU_BYTES, IMAGE_BYTES = 360, 921_600
LIVE_RATE = 40_000
PAUSE_S = 0.005


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run, packets per spool."""
    share = 0.1 if is_quick else 1.0
    return Subject(
        "recording: what it costs a run, and what the recorder keeps up with",
        (_whiskeye(0.2 if is_quick else 1.0), _recorder(share), *_floods(is_quick)),
    )


def _whiskeye(share: float) -> Group:
    """Within a run, recorded and not in turn: two runs of one program differ by far more."""
    candidates: dict[str, Measurement] = {}
    cases = []
    for name, project in PROJECTS.items():
        for backend, label in (("process", "process"), ("in-process", "in process")):
            recorded_run = f"{name}, {label}"
            candidates[recorded_run] = functools.partial(
                speed_with,
                "recording",
                WHISKEYE / f"{project}.json",
                backend,
                SLICE_S,
                {"nodes.robot.environment.DURATION": share * SIMULATED_S},
                RECORD,
            )
            cases.append(
                Case(
                    f"whiskeye {recorded_run}, recorded: share of the speed without recording",
                    "",
                    Figure(recorded_run, "speed"),
                    bound=f"recorded-{name}" if backend == "process" else None,
                )
            )
    return Group(candidates, tuple(cases))


def _recorder(share: float) -> Group:
    candidates: dict[str, Measurement] = {
        "IMU": functools.partial(recorded, IMU_BYTES, round(100_000 * share)),
        "image": functools.partial(recorded, IMAGE_BYTES, round(500 * share)),
    }
    candidates["live"] = functools.partial(live, IMU_BYTES, 4.0 * share)
    cases = (
        Case(
            "recorder, IMU packets of 4 nodes, live",
            "1/s",
            Figure("live", "rate"),
            bound="recorder-live",
        ),
        Case("recorder, bag complete after the last of them", "s", Figure("live", "behind_s")),
        Case("recorder, IMU packets", "1/s", Figure("IMU", "rate"), bound="recorder-packets"),
        Case("recorder, VGA images", "MB/s", Figure("image", "volume"), bound="recorder-volume"),
        Case("node, keep an IMU packet", "us", Figure("IMU", "keep_us")),
        Case("node, keep a VGA image", "us", Figure("image", "keep_us")),
    )
    return Group(candidates, cases, MINIMUM_PAIRS)


def _floods(is_quick: bool) -> tuple[Group, ...]:
    """As many packets as a connection carries, recorded and not."""
    seconds = 0.3 if is_quick else 2.0
    return (
        _flood(IMU_PACKET, "process", seconds),
        _flood(IMU_PACKET, "in-process", seconds),
        _flood(LARGE, "process", seconds),
    )


def _flood(packet: Packet, backend: str, seconds: float) -> Group:
    run = functools.partial(flooding.neuros, packet, backend, seconds, {"discard_limit": 0})
    is_image = packet is LARGE
    figure, unit = ("volume", "MB/s") if is_image else ("rate", "1/s")
    name = f"throughput, {packet.name}, {backend.replace('-', ' ')}, discard limit 0, recorded"
    cases = (
        Case(
            name, unit, Figure("recorded", figure), Figure("not recorded", figure), "not recorded"
        ),
        Case(f"{name}: bag complete after the last packet", "s", Figure("recorded", "behind_s")),
    )
    candidates: dict[str, Measurement] = {
        "not recorded": run,
        "recorded": functools.partial(run, options=RECORD),
    }
    return Group(candidates, cases, rounds=6)


def live(size: int, seconds: float) -> dict[str, float]:
    """Four nodes keep packets, faster together than is asked for, while the recorder runs.

    ``rate`` is of all packets, from the first one until the bag is complete with none missing.
    """
    names = "abcd"
    count = round(LIVE_RATE * seconds / len(names))
    topics = tuple(Topic(f"/neuros/{n}/out/z/{n}/data", "std_msgs/msg/String") for n in names)
    streams = {name: (RecordedStream("sent", "out", (place,)),) for place, name in enumerate(names)}
    plan = RecordingPlan(topics, streams)
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        run = Path(folder)
        plan.save(run)
        command = [sys.executable, "-m", "neuros.cli", "recorder", folder]
        recorder = RecorderProcess(command, run, run / "log", {})
        senders = [SpoolWriter(run / name, plan.streams[name]) for name in names]
        start_s = time.perf_counter()
        for number in range(count):
            for sender in senders:
                sender.keep(0, bytes(size), None)
            ahead_s = number * len(names) / LIVE_RATE - (time.perf_counter() - start_s)
            if ahead_s > PAUSE_S:
                time.sleep(ahead_s)
        sent_s = time.perf_counter()
        for sender in senders:
            sender.close()
        done = recorder.finish(lambda: False)
        end_s = time.perf_counter()
    if done.problems or sum(done.counts.values()) != count * len(names):
        raise RuntimeError(f"{done.counts} of {count} packets each: {done.problems}")
    return {"rate": count * len(names) / (end_s - start_s), "behind_s": end_s - sent_s}


def recorded(size: int, count: int) -> dict[str, float]:
    """Keep packets of a size, and move them into a bag: a node's side, and the recorder's."""
    topic = Topic("/neuros/a/out/b/in/data", "std_msgs/msg/String")
    plan = RecordingPlan((topic,), {"a": (RecordedStream("sent", "out", (0,)),)})
    data = bytes(size)
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        run = Path(folder)
        spool = SpoolWriter(run / "a", plan.streams["a"])
        start_s = time.perf_counter()
        for _ in range(count):
            spool.keep(0, data, None)
        kept_s = time.perf_counter()
        spool.close()
        recorder = Recorder(plan, run, complain=print)
        moved_s = time.perf_counter()
        while recorder.poll():
            pass
        recorder.complete()
        end_s = time.perf_counter()
        recorder.clean_up()
    return {
        "keep_us": (kept_s - start_s) / count * 1e6,
        "rate": count / (end_s - moved_s),
        "volume": count * size / (end_s - moved_s) / 1e6,
    }
