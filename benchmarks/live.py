"""A project that runs while something else about it is measured: its memory, its processor time."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

PATIENCE_S = 120.0
"""How long nodes may take to start: 64 of them share two cores."""

_END_S = 20.0
_PAUSE_S = 0.02


@dataclass(frozen=True)
class Live:
    """A run that goes on.

    Attributes:
        command_ns: when its command was given, on the monotonic clock.
        launcher: the process of the command.
        folder: of the run.
    """

    command_ns: int
    launcher: psutil.Process
    folder: Path
    output: Path

    def wait_for(self, names: Sequence[str], file: str) -> list[str]:
        """What these nodes have written to a file, as soon as all of them have.

        Raises:
            RuntimeError: if the project ends before.
            TimeoutError: if they take too long.
        """
        texts: dict[str, str] = {}

        def are_all_there() -> bool:
            for name in names:
                path = self.folder / name / file
                if name not in texts and path.exists() and (text := path.read_text()):
                    texts[name] = text
            return len(texts) == len(names)

        self._wait_until(are_all_there)
        return [texts[name] for name in names]

    def printed(self, pattern: str) -> str:
        """The group of ``pattern``, once the launcher has printed a match; raises as above."""
        found: list[str] = []

        def is_there() -> bool:
            found[:] = re.findall(pattern, self.output.read_text())
            return bool(found)

        self._wait_until(is_there)
        return found[0]

    def finished(self) -> dict[str, Any]:
        """Wait for its own end; returns its ``run.json``.

        Raises:
            RuntimeError: if it has failed.
            psutil.TimeoutExpired: if it takes too long.
        """
        code = self.launcher.wait(PATIENCE_S)
        if code:
            raise RuntimeError(f"exit code {code}:\n{self.output.read_text()}")
        record: dict[str, Any] = json.loads((self.folder / "run.json").read_text())
        return record

    def check(self) -> None:
        """Raise ``RuntimeError`` if the project has ended."""
        if not self.launcher.is_running() or self.launcher.status() == psutil.STATUS_ZOMBIE:
            raise RuntimeError(f"the project has ended:\n{self.output.read_text()}")

    def processes(self) -> list[psutil.Process]:
        """The launcher and all that it has started, its guardian included."""
        return [self.launcher, *self.launcher.children(recursive=True)]

    def host_of(self, name: str) -> psutil.Process:
        """The process of a node."""
        node_file = str(self.folder / name / "node.json")
        return next(each for each in self.processes() if node_file in each.cmdline())

    def _wait_until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self.check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"still starting after {PATIENCE_S:g} s")
            time.sleep(_PAUSE_S)


@contextlib.contextmanager
def live(
    project: Path,
    backend: str,
    settings: Mapping[str, object] | None = None,
    options: Sequence[str] = (),
) -> Iterator[Live]:
    """Launch a project, with further options; it is ended when the block is left."""
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        run_folder, output = Path(name) / "run", Path(name) / "output"
        command = [sys.executable, "-m", "neuros.cli", "launch", str(project)]
        command += ["--backend", backend, "-o", str(run_folder), *options]
        for key, value in (settings or {}).items():
            command += ["--set", f"{key}={value}"]
        with output.open("w") as file:
            command_ns = time.monotonic_ns()
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                env={**os.environ, "NEUROS_GUI": "0"},
            )
        try:
            yield Live(command_ns, psutil.Process(process.pid), run_folder, output)
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a launcher, which ends its nodes; were it killed, its guardian would."""
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
