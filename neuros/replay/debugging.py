"""Debuggers that a replay can run under."""

from __future__ import annotations

import bdb
import pdb
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from neuros.errors import EnvironmentFault, UsageError

HOST = "127.0.0.1"


class Debugger:
    """Python's own debugger, at the start of every hook and after a failure."""

    def __init__(self) -> None:
        self._pdb = pdb.Pdb(nosigint=True, readrc=False)

    def run(self, action: Callable[[], None], functions: Iterable[Any]) -> None:
        """Run ``action`` with a breakpoint at the start of each of these functions."""
        for function in functions:
            code = function.__code__
            self._pdb.set_break(code.co_filename, code.co_firstlineno, funcname=code.co_name)
        self._pdb.rcLines = ["continue"]  # it would stop in NeuROS first
        self._pdb.runcall(action)

    def look_at(self, error: BaseException) -> None:
        """Let the user look at where an error came from."""
        print(f"{type(error).__name__}: {error}")
        self._pdb.reset()
        self._pdb.interaction(None, error.__traceback__)


def is_quit(error: BaseException | None) -> bool:
    """Whether the user has left a debugger, or pressed Ctrl+C: anywhere in an error's causes."""
    while error is not None:
        if isinstance(error, bdb.BdbQuit | KeyboardInterrupt):
            return True
        error = error.__cause__
    return False


@contextmanager
def debugpy_on(port: int | None) -> Iterator[None]:
    """Wait for an editor to attach, if a port is given.

    Raises:
        EnvironmentFault: if debugpy is not installed.
        UsageError: if the port cannot be used.
    """
    if port is not None:
        try:
            import debugpy
        except ImportError as error:
            raise EnvironmentFault(
                "--debugpy: debugpy is not installed for the Python of this node:"
                " pip install debugpy, or use --pdb"
            ) from error
        try:
            debugpy.listen((HOST, port))
        except (RuntimeError, OSError) as error:
            raise UsageError(f"--debugpy {port}: {error}") from error
        print(f"waiting for a debugger to attach to {HOST}:{port}", flush=True)
        debugpy.wait_for_client()
    yield
