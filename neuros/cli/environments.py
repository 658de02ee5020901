"""Makes what a run needs before it begins, and can be ended by signals while it does."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from types import FrameType

from neuros.api.environments import are_made, make_environments
from neuros.launch.environments.pythons import Pythons
from neuros.messages.needed import Messages

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def make_shown_environments(
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
    heeding = nullcontext() if are_made(pythons, messages) else _signals_interrupt(signals)
    try:
        with heeding:
            make_environments(pythons, messages, _Output())
    except KeyboardInterrupt:
        return 130 if signals[:1] == [signal.SIGINT] else 143
    return 0


def build_messages(messages: Messages) -> int:
    """Build message packages; returns 0, or the exit code of a signal that ended it.

    Raises:
        EnvironmentFault: with what failed.
    """
    return make_shown_environments(Pythons({}), [], messages)


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
