"""Runs projects as a user does, through the command line; for the tests that look at whole runs.

::

    run = launch(EXAMPLES / "1_tick/clock", "--duration", "1", cwd=tmp_path)
    assert run.exit_code == 0
    assert run.connection("clock.time -> display.time")["sent"] == 1

    with start(project, cwd=tmp_path) as running:
        running.wait_for("It is")
        running.signal(signal.SIGINT)
        assert running.finish().exit_code == 130
"""

from __future__ import annotations

import json
import os
import re
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import pytest

from tests.support.preloaded import PreloadedLauncher, may_fork

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLES = REPOSITORY / "examples"
BACKENDS = ("process", "in-process")
LAUNCH = (sys.executable, "-m", "neuros.cli", "launch")

_RECORD = re.compile(r"\[[A-Z]+\] \[[\d.]+\] \[(?P<name>[^\]]+)\]: (?P<text>.*)")
_UNWANTED = ("ROS_DOMAIN_ID", "NEUROS_GUI", "NEUROS_RUN_DIR", "RCUTILS_COLORIZED_OUTPUT")
_GRACE_S = 12.0  # for a launcher that is asked to end, before it is killed


@dataclass(frozen=True)
class Finished:
    """A run that is over.

    Attributes:
        output: standard output and error of the launcher.
        run_folder: ``None`` where the run did not come as far as having one.
        record: the content of ``run.json``, empty if there is none.
    """

    exit_code: int
    output: str
    run_folder: Path | None
    record: Mapping[str, Any]

    def connection(self, name: str) -> Mapping[str, Any]:
        """The counters of ``"a.out -> b.in"``."""
        found = [c for c in self.record["connections"] if c["connection"] == name]
        assert found, f"no connection '{name}' in {self.record['connections']}"
        return dict(found[0])

    def said(self, node: str) -> list[str]:
        """What a node has logged, in order; ``"neuros"`` is the launcher itself."""
        records = (_RECORD.fullmatch(line) for line in self.output.splitlines())
        return [record["text"] for record in records if record and record["name"] == node]


class Running:
    """A launcher at work. As a context manager it leaves nothing behind."""

    def __init__(
        self, process: subprocess.Popen[bytes] | PreloadedLauncher, cwd: Path, before: set[Path]
    ) -> None:
        self.process = process
        self._cwd = cwd
        self._before = before
        self._output = bytearray()

    @property
    def output(self) -> str:
        """What has been read so far."""
        return self._output.decode(errors="replace")

    def wait_for(self, text: str, timeout_s: float = 15.0) -> None:
        """Until the launcher has printed ``text``; fails if it does not in time."""
        deadline_s = time.monotonic() + timeout_s
        while text not in self.output:
            if not self._read(deadline_s):
                raise AssertionError(f"{text!r} was not printed:\n{self.output}")

    def read(self, timeout_s: float) -> bool:
        """Read what comes next; False at the end of the output, and where nothing comes in time."""
        return self._read(time.monotonic() + timeout_s)

    def signal(self, number: int) -> None:
        """Send a signal to the launcher alone."""
        self.process.send_signal(number)

    def finish(self, timeout_s: float = 60.0) -> Finished:
        """Wait for the end; fails if it does not come in time, having ended everything."""
        deadline_s = time.monotonic() + timeout_s
        while self._read(deadline_s):
            pass
        try:
            exit_code = self.process.wait(max(0.1, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.close()
            raise AssertionError(f"not ended after {timeout_s:g} s:\n{self.output}") from None
        folder = next(iter(_run_folders(self._cwd) - self._before), None)
        return Finished(exit_code, self.output, folder, _record(folder))

    def close(self) -> None:
        """End the run if it goes on: politely, then by force (its guardian ends the nodes)."""
        assert self.process.stdout is not None
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            deadline_s = time.monotonic() + _GRACE_S
            while self._read(deadline_s):
                pass
            try:
                self.process.wait(max(0.1, deadline_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self.process.stdout.close()

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self, deadline_s: float) -> bool:
        """Read what comes next; False at the end of the output, and at the deadline."""
        assert self.process.stdout is not None
        if self.process.stdout.closed:
            return False
        with selectors.DefaultSelector() as selector:
            selector.register(self.process.stdout, selectors.EVENT_READ)
            if not selector.select(max(0.0, deadline_s - time.monotonic())):
                return False
        data = os.read(self.process.stdout.fileno(), 1 << 16)
        self._output += data
        return bool(data)


def start(
    project: Path | str,
    *arguments: str,
    cwd: Path,
    through: Sequence[str] = (),
    program: Sequence[str] = (),
    stdin: int | IO[bytes] = subprocess.DEVNULL,
    **environment: str,
) -> Running:
    """Start ``neuros launch PROJECT ARGUMENTS`` in the folder ``cwd``; ``-o`` is relative to it.

    ``through`` is a command that executes the one that follows it, with the same process id;
    ``program`` is what launches, if that is to be another command than ours.
    """
    inherited = {key: value for key, value in os.environ.items() if key not in _UNWANTED}
    whole = {**inherited, **environment}
    before = _run_folders(cwd)
    if not through and not program and stdin == subprocess.DEVNULL and may_fork(whole):
        return Running(PreloadedLauncher([str(project), *arguments], cwd, whole), cwd, before)
    process = subprocess.Popen(
        [*through, *(program or LAUNCH), str(project), *arguments],
        cwd=cwd,
        env=whole,
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    return Running(process, cwd, before)


def launch(
    project: Path | str,
    *arguments: str,
    cwd: Path,
    timeout_s: float = 60.0,
    **environment: str,
) -> Finished:
    """Run ``neuros launch PROJECT ARGUMENTS`` in the folder ``cwd`` to its end."""
    with start(project, *arguments, cwd=cwd, **environment) as running:
        return running.finish(timeout_s)


def each_time(backend: str) -> pytest.MarkDecorator:
    """Give a test both back ends: this one each time, the other before a release."""
    others = [each for each in BACKENDS if each != backend]
    rare = [pytest.param(each, marks=pytest.mark.acceptance) for each in others]
    return pytest.mark.parametrize("backend", [backend, *rare])


def killed_in_a_hook(running: Running, timeout_s: float) -> Finished:
    """A run of ``tests/integration/back_ends/stuck``, after Ctrl+C twice."""
    running.wait_for("[reader]: computing", timeout_s)
    running.signal(signal.SIGINT)
    running.wait_for("a second one kills at once")
    running.signal(signal.SIGINT)
    return running.finish(timeout_s)


def _run_folders(cwd: Path) -> set[Path]:
    """Folders below ``cwd`` that are run folders."""
    return {
        file.parent for file in cwd.rglob("project.json") if (file.parent / "run.json").exists()
    }


def _record(folder: Path | None) -> Mapping[str, Any]:
    if folder is None:
        return {}
    record: Mapping[str, Any] = json.loads((folder / "run.json").read_text())
    return record
