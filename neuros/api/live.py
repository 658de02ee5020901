"""A run that goes on in the background of a Python program."""

from __future__ import annotations

import atexit
import contextlib
import io
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from neuros.api.execution import Execution
from neuros.api.plan import Plan
from neuros.api.run import Run
from neuros.launcher.outcome import EXIT_CODES, SIGNAL_NAMES

PROGRAM_FAILED = 7
"""The exit code of a run whose program has failed."""


class LiveRun:
    """A run in a thread of its own, from :meth:`begin` on; :meth:`wait` returns the result.

    As a context manager, the end of the block stops the run and waits for its end::

        with project.start(backend="process") as run:
            ...
        print(run.wait())

    It installs no signal handlers: an interrupt of a program or notebook that waits ends the run as
    Ctrl+C does, and then raises ``KeyboardInterrupt``. A program that ends, ends its runs. Several
    runs may go on at once.

    Raises:
        UsageError, EnvironmentFault: if it cannot begin.
    """

    def __init__(self, plan: Plan, *, is_shown: bool) -> None:
        self._signals: list[int] = []
        self._wishes: list[tuple[str, int]] = []
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._done = threading.Event()
        # Held by the thread that executes the run, or by a call that cancels it before.
        self._claim = threading.Lock()
        self._error: BaseException | None = None
        output: Any = _CurrentOutput()
        try:
            self._execution = Execution(
                plan,
                # A file only if standard output is that of the program.
                (sys.stdout if sys.stdout is sys.__stdout__ else output) if is_shown else None,
                self._signals,
                self._reader,
                self._wishes,
            )
        except BaseException:
            self._hang_up()
            raise

    def begin(self) -> None:
        """Start the run; from now on it has to be ended."""
        try:
            atexit.register(self._end_with_program)
            threading.Thread(target=self._execute, name="neuros-run", daemon=True).start()
        except BaseException:
            self.end()
            raise

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self._execution.folder

    @property
    def control_address(self) -> str:
        """Where observers connect to its control channel."""
        return self._execution.control_address

    @property
    def is_running(self) -> bool:
        """Whether the run has not ended yet."""
        return not self._done.is_set()

    def stop(self, reason: str = "stopped by the program") -> None:
        """End the run as if ``--duration`` were over: drained, with exit code 0."""
        self._wishes.append((reason, 0))
        self._wake()

    def fail(self, reason: str, exit_code: int) -> None:
        """End the run now, since this program has failed; after Ctrl+C, as :meth:`interrupt`."""
        if exit_code == EXIT_CODES[signal.SIGINT]:
            self.interrupt()
            return
        self._wishes.append((reason, exit_code))
        self._wake()

    def interrupt(self) -> None:
        """Do what Ctrl+C does: end the run now, with exit code 130; a second call kills it."""
        self._signals.append(signal.SIGINT)
        self._wake()

    def wait(self, timeout_s: float | None = None) -> Run:
        """Wait for the end of the run.

        Raises:
            TimeoutError: if the run has not ended after ``timeout_s`` seconds; it goes on.
            EnvironmentFault: if the run could not be started.
            KeyboardInterrupt: if interrupted; the run has then been ended in order.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        interrupted: KeyboardInterrupt | None = None
        while True:
            try:
                left_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
                if not self._done.wait(left_s):
                    raise TimeoutError(f"not ended after {timeout_s:g} s: {self.folder}")
                break
            except KeyboardInterrupt as error:
                interrupted, deadline_s = error, None
                self.interrupt()
        if interrupted is not None:
            raise KeyboardInterrupt(f"the run was ended; its folder: {self.folder}") from None
        if self._error is not None:
            raise self._error
        return Run(self.folder)

    def end(self) -> None:
        """End the run as Ctrl+C does, and wait; a run that has not begun never does."""
        if self._claim.acquire(blocking=False):
            self._execution.cancel()
            self._finish()
        elif self.is_running:
            self.interrupt()
        self.join()

    def join(self) -> None:
        """Wait for the end of the run."""
        self._done.wait()

    def __enter__(self) -> LiveRun:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.stop()
        else:
            self.fail(*why_it_ended(error))
        self.wait()

    def __repr__(self) -> str:
        return f"<{'running' if self.is_running else 'ended'} run in {self.folder}>"

    def _execute(self) -> None:
        if not self._claim.acquire(blocking=False):
            return
        try:
            self._execution.run()
        except BaseException as error:  # raised again by wait()
            self._error = error
        finally:
            self._finish()

    def _finish(self) -> None:
        self._hang_up()
        atexit.unregister(self._end_with_program)
        self._done.set()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # the run has ended, or is awake
            self._writer.send(b"\0")

    def _hang_up(self) -> None:
        self._reader.close()
        self._writer.close()

    def _end_with_program(self) -> None:
        self.interrupt()
        self._done.wait()


def why_it_ended(error: BaseException) -> tuple[str, int]:
    """The reason and the exit code of a run whose program fails."""
    if isinstance(error, KeyboardInterrupt):
        return f"ended by {SIGNAL_NAMES[signal.SIGINT]}", EXIT_CODES[signal.SIGINT]
    text = ": ".join([type(error).__name__, *str(error).strip().splitlines()[:1]])
    return f"the program failed: {text}", PROGRAM_FAILED


class _CurrentOutput(io.TextIOBase):
    """Writes to the current ``sys.stdout``: a cell of a notebook, or the capture of pytest."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        sys.stdout.write(text)
        sys.stdout.flush()
        return len(text)
