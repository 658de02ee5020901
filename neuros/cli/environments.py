"""Virtual environments and message packages, made before a run begins; signals interrupt it."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType

from neuros.api.plan import are_made, make_environments
from neuros.backends.pythons import Pythons
from neuros.errors import EnvironmentFault
from neuros.messages.needed import Messages
from neuros.messages.workspace import message_cache
from neuros.recording.run_file import read_object

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def make_shown_environments(
    pythons: Pythons, signals: list[int], messages: Messages | None = None
) -> int:
    """Make missing environments and messages; returns 0, or the exit code of a signal.

    Args:
        signals: the signals so far; further ones are added.

    Raises:
        EnvironmentFault: with all failures.
    """
    for notice in pythons.notices:
        print(f"neuros: {notice}", file=sys.stderr)
    heeding = nullcontext() if are_made(pythons, messages) else signals_interrupt(signals)
    try:
        with heeding:
            make_environments(pythons, messages, _Output())
    except KeyboardInterrupt:
        return 130 if signals[:1] == [signal.SIGINT] else 143
    return 0


def build_messages(messages: Messages) -> int:
    """Build message packages; returns 0, or the exit code of a signal.

    Raises:
        EnvironmentFault: with all failures.
    """
    return make_shown_environments(Pythons({}), [], messages)


class _Output(io.TextIOBase):
    """Standard output, without an error if it is closed."""

    def isatty(self) -> bool:
        return os.isatty(1)

    def write(self, text: str) -> int:
        with suppress(OSError):
            os.write(1, text.encode(errors="replace"))
        return len(text)


@contextmanager
def signals_interrupt(signals: list[int]) -> Iterator[None]:
    """Turn signals that end a run into ``KeyboardInterrupt``."""

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


def find_messages_of(run: Path) -> None:
    """Put the message packages of a run on the path, given its folder or its bag."""
    for folder in (run, run.parent):
        for file in folder.glob("*/node.json"):
            with suppress(OSError, EnvironmentFault):
                listed = read_object(file).get("messages")
                told = listed if isinstance(listed, list) else []
                entries = (Path(path).parent.name for path in told if isinstance(path, str))
                paths = [str(message_cache(os.environ) / entry / "python") for entry in entries]
                sys.path[:0] = [path for path in paths if path not in sys.path]
            return
