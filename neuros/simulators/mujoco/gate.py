"""Whose turn it is with model and data: the stepping thread, or a visitor."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Gate:
    """The stepping thread passes between two bouts of steps; visitors go first.

    A plain lock would starve visitors: the stepping thread would take it again at once.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._one_visitor = threading.RLock()
        self._visitors = 0
        self._is_stepping = False
        self._is_closed = False

    @property
    def is_closed(self) -> bool:
        """Whether stepping is paused."""
        return self._is_closed

    @contextmanager
    def visit(self) -> Iterator[None]:
        """No step runs inside; nests; visitors of other threads wait."""
        with self._one_visitor:
            with self._changed:
                self._visitors += 1
                self._changed.wait_for(lambda: not self._is_stepping)
            try:
                yield
            finally:
                with self._changed:
                    self._visitors -= 1
                    self._changed.notify_all()

    def close(self) -> None:
        """Let no step begin until :meth:`open`; returns at once."""
        self._is_closed = True

    def open(self) -> None:
        with self._changed:
            self._is_closed = False
            self._changed.notify_all()

    def wake(self) -> None:
        """Ask everybody who waits to look at what they wait for again."""
        with self._changed:
            self._changed.notify_all()

    def wait_open(self, seconds: float) -> None:
        """Wait until the gate is open, at most ``seconds``, or until :meth:`wake`."""
        with self._changed:
            if self._is_closed:
                self._changed.wait(seconds)

    def enter(self, cancelled: Callable[[], bool], seconds: float | None = None) -> bool:
        """Begin a bout of steps as soon as nobody visits and the gate is open.

        Returns False, without having begun, once ``cancelled()``, or after ``seconds`` of waiting.
        """
        with self._changed:
            may_try = self._changed.wait_for(
                lambda: cancelled() or not (self._is_closed or self._visitors), seconds
            )
            if cancelled() or not may_try:
                return False
            self._is_stepping = True
            return True

    def leave(self) -> None:
        """End a bout of steps."""
        with self._changed:
            self._is_stepping = False
            self._changed.notify_all()
