"""Launchers that are forked from a process which has imported what they need.

Imports are more than half of the processor time of a launch, and the tests launch some 800 times.
What runs is the same: ``neuros launch`` in a process, session, folder and environment of its own.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from pathlib import Path

import pytest

_FORKING = multiprocessing.get_context("forkserver")
_FORKING.set_forkserver_preload(
    [
        "tests.support.preloaded",
        "jsonschema",
        "numpy.ma",  # numpy.unique() imports it
        "msgspec",
        "tabulate",
        "xxhash",
        "neuros.cli.launch",
        "neuros.cli.environments",
        "neuros.api.execution",
        "neuros.api.loading",
        "neuros.api.packets",
        "neuros.backends.process_launchers",
    ]
)
_READ_AT_START = ("LD_", "PYTHON")


def may_fork(environment: Mapping[str, str]) -> bool:
    """Whether no variable differs that an interpreter reads when it starts."""
    return _read_at_start(environment) == _of_the_server()


def _read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    return {key: text for key, text in environment.items() if key.startswith(_READ_AT_START)}


@cache
def _of_the_server() -> dict[str, str]:
    """Start the process that forks; returns those variables of its environment."""
    with pytest.MonkeyPatch.context() as patch:
        # As in main(); and NumPy would start threads otherwise, which a fork does not take along.
        patch.setenv("OPENBLAS_NUM_THREADS", "1")
        ensure_running()
    return _read_at_start(os.environ)


class PreloadedLauncher:
    """``neuros launch ARGUMENTS`` (as :class:`subprocess.Popen`, as far as tests use that)."""

    def __init__(self, arguments: list[str], cwd: Path, environment: Mapping[str, str]) -> None:
        output, theirs = _FORKING.Pipe(duplex=False)
        with output, theirs:
            self._process = _FORKING.Process(
                target=_launch, args=(arguments, cwd, dict(environment), theirs)
            )
            self._process.start()
            self.stdout = os.fdopen(os.dup(output.fileno()), "rb", 0)
        pid = self._process.pid
        assert pid is not None
        self.pid = pid

    @property
    def returncode(self) -> int | None:
        """Its exit code, negative for a signal, once :meth:`poll` or :meth:`wait` has seen it."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """Its exit code; ``None`` while it runs."""
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, as soon as it has ended; raises ``subprocess.TimeoutExpired``."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("neuros launch", timeout or 0.0)
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it ends, and is reaped, meanwhile
                os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill it."""
        self._process.kill()


def _launch(
    arguments: list[str], cwd: Path, environment: Mapping[str, str], output: Connection
) -> None:
    os.setsid()
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    for descriptor in (1, 2):
        os.dup2(output.fileno(), descriptor)
    output.close()
    sys.argv = ["neuros", "launch", *arguments]
    from neuros.cli.main import console_script

    console_script()
