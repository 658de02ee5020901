"""Programs that are measured without NeuROS: started on chosen cores, ended whatever happens."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from benchmarks.machine import ROOT
from benchmarks.measure import Unavailable
from neuros.backends.domain import choose_domain
from neuros.backends.guardian_program import children_on
from neuros.backends.node_command import usable_cores

END_S = 5.0


def cores() -> tuple[int, ...]:
    """The cores that may be used."""
    return tuple(sorted(usable_cores()))


def two_cores() -> tuple[int, int]:
    """Two different cores.

    Raises:
        Unavailable: on a machine with one.
    """
    if len(cores()) < 2:
        raise Unavailable("there is one core only")
    return cores()[0], cores()[1]


@contextlib.contextmanager
def running(
    command: Sequence[str],
    environment: Mapping[str, str],
    chosen: Sequence[int] | None = None,
    folder: Path = ROOT,
) -> Iterator[subprocess.Popen[str]]:
    """A process with pipes to and from it, while the block lasts.

    At the end its input is closed, which is what ends the programs of the benchmarks; one that
    takes no notice is terminated, and then killed.
    """
    with children_on(chosen):
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment,
        )
    try:
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen[str]) -> None:
    """End a process, gently at first; returns when it is gone."""
    with contextlib.suppress(BrokenPipeError):  # what it was told and did not read
        _pipe(process.stdin).close()
    try:
        for insist in (process.poll, process.terminate):
            insist()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(END_S)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        _pipe(process.stdout).close()
        _pipe(process.stderr).close()


def _pipe(stream: IO[str] | None) -> IO[str]:
    assert stream is not None  # all three are pipes
    return stream


def answer(process: subprocess.Popen[str], timeout_s: float) -> str:
    """What it prints until it ends; its input stays open, as the end of that would end it.

    Raises:
        RuntimeError: if it ends with another exit code than 0 (or is killed, since it does not end
            in time), with its errors.
    """
    timer = threading.Timer(timeout_s, process.kill)
    timer.start()
    try:
        output, errors = _pipe(process.stdout).read(), _pipe(process.stderr).read()
        process.wait()
    finally:
        timer.cancel()
    if process.returncode:
        raise RuntimeError(f"{process.args!r}: exit code {process.returncode}\n{errors}")
    return output


@contextlib.contextmanager
def ros_environment(profiles: Path | None = None) -> Iterator[dict[str, str]]:
    """Environment variables for a free ROS domain that stays on this machine.

    Args:
        profiles: settings of Fast DDS, instead of its own.
    """
    with choose_domain(None, {}, False) as domain:
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain.id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        if profiles is not None:
            environment["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profiles)
        yield environment


def program(name: str, *arguments: object) -> list[str]:
    """The command that runs a module of ``benchmarks.programs``."""
    return [sys.executable, "-m", f"benchmarks.programs.{name}", *map(str, arguments)]
