"""Starting a project as a user does, with processes on chosen cores where a measurement says so."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

PLUGINS = Path(__file__).resolve().parent / "plugins"

_START_S = 30.0
_RUN_S = 300.0


def cores() -> tuple[int, ...]:
    """The cores that may be used."""
    return tuple(sorted(os.sched_getaffinity(0)))


@contextlib.contextmanager
def project_of_plugins(project: Mapping[str, Any]) -> Iterator[Path]:
    """A temporary folder with the plugins of the benchmarks and this ``project.json``."""
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        folder = Path(name)
        shutil.copytree(PLUGINS, folder, dirs_exist_ok=True)
        (folder / "project.json").write_text(json.dumps(project))
        yield folder


def launch(
    project: Path,
    run_folder: Path,
    backend: str,
    *,
    settings: Mapping[str, Any] | None = None,
    own_core: str | None = None,
) -> dict[str, Any]:
    """Run a project to its end; returns its ``run.json``.

    Args:
        run_folder: must not exist yet.
        settings: values for ``--set``.
        own_core: a node (of the process back end) that gets the first core; all the rest, the
            launcher included, share the others. ``None`` leaves placement to the kernel.

    Raises:
        RuntimeError: if it does not end with 0, with what it printed.
    """
    command = [sys.executable, "-m", "neuros.cli", "launch", str(project)]
    command += ["--backend", backend, "-o", str(run_folder)]
    for key, value in (settings or {}).items():
        command += ["--set", f"{key}={value}"]
    environment = {**os.environ, "NEUROS_GUI": "0"}
    first, *others = cores()
    with on_cores(others if own_core else cores()):
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
    try:
        if own_core:
            move(_process_of(run_folder / own_core / "node.json", process), [first])
        output, _ = process.communicate(timeout=_RUN_S)
    finally:
        if process.poll() is None:
            process.terminate()  # it ends its nodes
            process.wait()
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit code {process.returncode}\n{output}")
    result: dict[str, Any] = json.loads((run_folder / "run.json").read_text())
    return result


@contextlib.contextmanager
def on_cores(chosen: Sequence[int]) -> Iterator[None]:
    """Let what is started inside run on these cores only."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, chosen)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def move(process_id: int, chosen: Sequence[int]) -> None:
    """Let all threads of a process, and those that it will start, run on these cores only."""
    moved: set[int] = set()
    tasks = Path(f"/proc/{process_id}/task")
    while threads := {int(each.name) for each in tasks.iterdir()} - moved:
        for thread in threads:
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(thread, chosen)
        moved |= threads


def _process_of(node_file: Path, launcher: subprocess.Popen[str]) -> int:
    """The process that was started with this file, as soon as it exists."""
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline and launcher.poll() is None:
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                with contextlib.suppress(OSError):
                    if str(node_file).encode() in (folder / "cmdline").read_bytes().split(b"\0"):
                        return int(folder.name)
        time.sleep(0.02)
    output = launcher.stdout.read() if launcher.poll() is not None and launcher.stdout else ""
    raise RuntimeError(f"no process was started for {node_file}\n{output}")
