"""One input fed to a target, and what is wrong with the answer."""

from __future__ import annotations

import signal
import tempfile
import traceback
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from .targets import Target

CONSTANT_BYTES = 64 << 20
"""Memory that any input may take; what is longer than a tenth of it may take ten times itself."""
PROCESSOR_S = 20
WALL_S = 120
"""A machine that does something else meanwhile must not look like a hang."""


class TooLong(BaseException):
    """No answer in time; no ``except Exception`` takes it for anything else."""


def fault_of(target: Target, data: bytes, *, measures_memory: bool = False) -> str:
    """What must not happen and has, with its traceback; empty if nothing has."""
    if measures_memory:
        tracemalloc.start()
    try:
        with _in_time(), tempfile.TemporaryDirectory(prefix="neuros-fuzz-") as folder:
            target.feed(data, Path(folder))
        if measures_memory:
            taken, most = tracemalloc.get_traced_memory()[1], CONSTANT_BYTES
            if taken > target.factor * len(data) + most:
                return f"{len(data)} bytes took {taken >> 20} MiB of memory"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return "".join(traceback.format_exception(error))
    finally:
        if measures_memory:
            tracemalloc.stop()
    return ""


@contextmanager
def _in_time() -> Iterator[None]:
    def give_up(number: int, frame: FrameType | None) -> None:
        raise TooLong(f"{PROCESSOR_S} s of processor time, or {WALL_S} s")

    kinds = {signal.SIGPROF: signal.ITIMER_PROF, signal.SIGALRM: signal.ITIMER_REAL}
    before = {number: signal.signal(number, give_up) for number in kinds}
    signal.setitimer(signal.ITIMER_PROF, PROCESSOR_S)
    signal.setitimer(signal.ITIMER_REAL, WALL_S)
    try:
        yield
    finally:
        for number, timer in kinds.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])
