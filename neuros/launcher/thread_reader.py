"""Reads where the threads of node processes stand, while the supervisor goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait

from neuros.ports import RunningNode
from neuros.stacks import ProcessThreads

_CLOSE_S = 3.0


class ThreadReader:
    """Reads processes side by side, each in a thread, since that may take seconds.

    Args:
        process_of: the process with a node; ``None`` if it has ended.
    """

    def __init__(self, process_of: Callable[[str], RunningNode | None]) -> None:
        self._process_of = process_of
        self._readings: dict[str, Future[ProcessThreads]] = {}  # by first node
        self._begun: list[threading.Thread] = []

    def begin(self, name: str) -> None:
        """Read the process whose first node this is, unless that has begun."""
        if name not in self._readings:
            reading = self._readings[name] = Future[ProcessThreads]()
            thread = threading.Thread(
                target=_read,
                args=(self._process_of(name), reading),
                name="neuros-stacks",
                daemon=True,
            )
            thread.start()
            self._begun = [*filter(threading.Thread.is_alive, self._begun), thread]

    def forget(self, name: str) -> None:
        """Drop what was read of a process, since it goes on."""
        self._readings.pop(name, None)

    def read(self, name: str) -> ProcessThreads | None:
        """What has been read since; ``None`` if that is not there."""
        reading = self._readings.get(name)
        return reading.result() if reading and reading.done() else None

    def wait(self, limit_s: float) -> None:
        """Until all that has begun is there, or the time is over."""
        wait(self._readings.values(), limit_s)

    def close(self) -> None:
        """Wait, for 3 s at most, until no program reads a process any more."""
        end_s = time.monotonic() + _CLOSE_S
        for thread in self._begun:
            thread.join(max(0.0, end_s - time.monotonic()))


def _read(process: RunningNode | None, reading: Future[ProcessThreads]) -> None:
    try:
        reading.set_result(ProcessThreads() if process is None else process.threads())
    except Exception as error:  # of a back end of somebody else
        reading.set_result(ProcessThreads(problem=repr(error)))
