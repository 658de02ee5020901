"""Starting a project as a user does."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

PLUGINS = Path(__file__).resolve().parent / "plugins"

RUN_S = 120.0


@contextlib.contextmanager
def project_of_plugins(project: Mapping[str, Any]) -> Iterator[Path]:
    """A temporary folder with the plugins of the benchmarks and this ``project.json``."""
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        folder = Path(name)
        shutil.copytree(PLUGINS, folder, dirs_exist_ok=True)
        (folder / "project.json").write_text(json.dumps(project))
        yield folder


def lines_from(site: Path, variable: str, project: Path, backend: str, **options: Any) -> list[str]:
    """Run a project to its end; returns the lines that a ``sitecustomize`` has written meanwhile.

    Every Python of the run imports that of the folder ``site``, and finds the name of the file to
    write to in the environment ``variable``. The options, and what is raised, are those of
    :func:`launch`.
    """
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        lines = Path(folder) / "lines"
        path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
        own = {**(options.pop("environment", None) or {}), "PYTHONPATH": path, variable: str(lines)}
        launch(project, Path(folder) / "run", backend, environment=own, **options)
        return lines.read_text().splitlines()


def launch(
    project: Path,
    run_folder: Path,
    backend: str,
    *,
    settings: Mapping[str, Any] | None = None,
    options: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    codes: Collection[int] = (0,),
    timeout_s: float = RUN_S,
) -> dict[str, Any]:
    """Run a project to its end; returns its ``run.json``.

    Args:
        run_folder: must not exist yet.
        settings: values for ``--set``.
        options: further ones of the command line.
        environment: variables on top of those of this process.
        codes: exit codes that are taken for success.
        timeout_s: how long it may take, from the command to its end.

    Raises:
        RuntimeError: if it ends with another exit code, with what it printed.
        subprocess.TimeoutExpired: if it takes longer; it is ended.
    """
    command = [sys.executable, "-m", "neuros.cli", "launch", str(project)]
    command += ["--backend", backend, "-o", str(run_folder), *options]
    for key, value in (settings or {}).items():
        command += ["--set", f"{key}={value}"]
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "NEUROS_GUI": "0", **(environment or {})},
    )
    try:
        output, _ = process.communicate(timeout=timeout_s)
    finally:
        if process.poll() is None:
            process.terminate()  # it ends its nodes
            process.wait()
    if process.returncode not in codes:
        raise RuntimeError(f"{' '.join(command)}: exit code {process.returncode}\n{output}")
    result: dict[str, Any] = json.loads((run_folder / "run.json").read_text())
    return result
