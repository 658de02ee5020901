"""Makes what a run needs before it begins: virtual environments, and message packages.

It can be interrupted at any time.
"""

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
from neuros.launch.wheels import without_mark
from neuros.messages.needed import Messages

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def make_environments(
    pythons: Pythons, signals: list[int], messages: Messages | None = None
) -> int:
    """Make what is missing, and say so; returns 0, or the exit code of a signal that ended it.

    Args:
        signals: those that have been noted so far, to which others are added.

    Raises:
        EnvironmentFault: with all that failed.
    """
    for notice in pythons.notices:
        print(f"neuros: {notice}", file=sys.stderr)
    pythons.note_use()
    if messages is not None:
        messages.note_use()
    if pythons.is_made and (messages is None or messages.is_made):
        return 0
    try:
        with _signals_interrupt(signals):
            _make(pythons, messages)
    except KeyboardInterrupt:
        return 130 if signals[:1] == [signal.SIGINT] else 143
    return 0


def build_messages(messages: Messages) -> int:
    """Build message packages; returns 0, or the exit code of a signal that ended it.

    Raises:
        EnvironmentFault: with what failed.
    """
    return make_environments(Pythons({}), [], messages)


def _make(pythons: Pythons, messages: Messages | None) -> None:
    # pip, the compiler, and what they start must not outlive a launcher that is killed.
    run_id = os.urandom(8).hex()
    guardian = Guardian.start(run_id)
    try:
        progress = Progress(_Output())
        if messages is not None:
            messages.make(progress, {**without_mark(os.environ), RUN_ID: run_id})
        pythons.make(progress, {RUN_ID: run_id})
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
