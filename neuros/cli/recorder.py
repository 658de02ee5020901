"""Program of the recorder process, which ``launch`` starts."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

from neuros.backends.sidecars import END
from neuros.errors import NeurosError
from neuros.ordinary_files import reason_of
from neuros.recording.recorder import Arrived, Recorder, counts_of, repair, the_only_recorder
from neuros.recording.recording_plan import BAG_NAME, RecordingPlan, Topic, load_plan

if TYPE_CHECKING:
    from neuros.transport.ros_topics import RosTopic

_POLL_S = 0.1
# The launcher was killed: its guardian kills what is left of the run after 4.5 s.
_ORPHANED_S = 4.0


def add_recorder(recorder: argparse.ArgumentParser) -> None:
    recorder.add_argument("run")
    recorder.set_defaults(command=_run_recorder)


def _run_recorder(options: argparse.Namespace) -> int:
    """Record a run until its launcher ends it or has ended; or complete its bag."""
    run = Path(options.run)
    problems = _Problems()
    counts: dict[str, int] = {}
    try:
        if (run / BAG_NAME).exists():
            repaired = repair(run, problems.add)
            counts = counts_of(run) if repaired is None else repaired.counts
        else:
            counts = _record(run, load_plan(run), problems.add)
    except (NeurosError, OSError) as error:
        reason = reason_of(error) if isinstance(error, OSError) else str(error)
        problems.add(
            f"the recording has stopped: {reason}; the bag can be read, and neuros bag repair"
            f" {run} adds the packets that it lacks"
        )
        with contextlib.suppress(OSError):
            counts = counts_of(run)
    print(json.dumps({"counts": counts, "problems": problems.texts}), flush=True)
    return 0


class _Problems:
    """Problems, for the log at once and for the launcher at the end."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def add(self, text: str) -> None:
        """Add a problem, a sentence. Any thread."""
        self.texts.append(text)
        with contextlib.suppress(OSError):  # the disk of the log may be full, too
            print(f"[ERROR] [{time.time():.9f}] [recorder]: {text}", file=sys.stderr, flush=True)


def _record(run: Path, plan: RecordingPlan, complain: Callable[[str], object]) -> dict[str, int]:
    arrived: SimpleQueue[Arrived] = SimpleQueue()
    with the_only_recorder(run), _listening(plan, arrived, complain) as unheard:
        recorder = Recorder(plan, run, complain, arrived=arrived)
        try:
            while True:
                wait_s = 0.0 if recorder.poll() else _POLL_S
                if not select.select([0], [], [], wait_s)[0]:
                    continue
                if os.read(0, len(END)) != END:  # the launcher was killed: nodes may go on
                    give_up_s = time.monotonic() + _ORPHANED_S
                    while recorder.is_fed and time.monotonic() < give_up_s:
                        recorder.poll()
                        time.sleep(_POLL_S)
                break
            for topic in unheard():
                complain(f"{topic} is not recorded: nobody published it")
            recorder.complete()
        except BaseException:
            recorder.abandon()
            raise
        recorder.clean_up()
        return recorder.counts()


@contextlib.contextmanager
def _listening(
    plan: RecordingPlan, arrived: SimpleQueue[Arrived], complain: Callable[[str], object]
) -> Iterator[Callable[[], list[str]]]:
    """Receive topics of others in a thread; yields its end, which returns the unpublished ones."""
    if not plan.listen:
        yield list
        return
    from neuros.transport.ros_topics import Listener

    unheard = list(plan.wanted)

    def found(topic: RosTopic) -> Callable[[int, bytes], None]:
        if topic.name in unheard:
            unheard.remove(topic.name)
        known = Topic(**asdict(topic))
        return lambda wall_ns, data: arrived.put((known, wall_ns, data))

    def refused(name: str, reason: str) -> None:
        if name in unheard:
            unheard.remove(name)
        complain(f"{name} is not recorded: {reason}")

    def failed(reason: str) -> None:
        complain(f"topics that no node has are not recorded from now on: {reason}")

    listener = Listener(plan.listen, found, refused, failed)
    thread = threading.Thread(target=listener.run, name="listener")
    thread.start()

    def stop() -> list[str]:
        listener.stop()
        thread.join()
        return unheard

    try:
        yield stop
    finally:
        stop()
