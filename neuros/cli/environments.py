"""Makes the virtual environments of a run before it begins; can be interrupted at any time."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from neuros.installation.progress import Progress
from neuros.launch.environments.pythons import Pythons
from neuros.launch.guardian import Guardian
from neuros.launch.run_processes import RUN_ID

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def make_environments(pythons: Pythons, signals: list[int]) -> int:
    """Make what is missing, and say so; returns 0, or the exit code of a signal that ended it.

    Args:
        signals: those that have been noted so far, to which others are added.

    Raises:
        EnvironmentFault: with all that failed.
    """
    for notice in pythons.notices:
        print(f"neuros: {notice}", file=sys.stderr)
    pythons.note_use()
    if pythons.is_made:
        return 0
    try:
        with _signals_interrupt(signals):
            _make(pythons)
    except KeyboardInterrupt:
        return 130 if signals[:1] == [signal.SIGINT] else 143
    return 0


def _make(pythons: Pythons) -> None:
    # pip, and what it starts, must not outlive a launcher that is killed.
    run_id = os.urandom(8).hex()
    guardian = Guardian.start(run_id)
    try:
        pythons.make(Progress(_Output()), {RUN_ID: run_id})
    finally:
        guardian.finish()


class _Output:
    """Standard output. A run goes on if nobody reads it any more, and so does this."""

    def isatty(self) -> bool:
        return os.isatty(1)

    def write(self, text: str) -> None:
        with suppress(OSError):
            os.write(1, text.encode(errors="replace"))

    def flush(self) -> None:
        """There is no buffer."""


@contextmanager
def _signals_interrupt(signals: list[int]) -> Iterator[None]:
    """Let what ends a run end this at once, by ``KeyboardInterrupt``."""

    def interrupt(number: int, _: FrameType | None) -> None:
        signals.append(number)
        raise KeyboardInterrupt

    heeded = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, interrupt) for number in heeded}
    try:
        if signals:
            raise KeyboardInterrupt
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
