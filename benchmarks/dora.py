"""Two nodes over dora-rs, if it is installed: ``./install.py --extras benchmark``."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import Unavailable
from benchmarks.processes import answer, running

PROGRAMS = Path(__file__).resolve().parent / "programs"
SHARED_MEMORY = Path("/dev/shm")

_END_S = 60.0


def run(
    sender: str,
    receiver: str,
    variables: Mapping[str, object],
    *,
    queue_size: int = 1,
    chosen: Sequence[int] | None = None,
) -> Any:
    """Let two programs send each other ``ball`` and ``back``; returns what they found out.

    Args:
        sender, receiver: programs ``dora_<name>.py``.
        variables: of their environment.
        queue_size: packets that an input holds.
        chosen: the cores of the two; dora's own process is not pinned. ``None``: nothing is.

    Raises:
        Unavailable: if dora-rs is not installed.
    """
    command = Path(sys.executable).parent / "dora"
    if importlib.util.find_spec("dora") is None or not command.exists():
        raise Unavailable("dora-rs is not installed (./install.py --extras benchmark)")
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        folder, result = Path(name), Path(name) / "result.json"
        environment = {key: str(value) for key, value in variables.items()}
        environment["RESULT"] = str(result)
        names = ((sender, "back", "ball", receiver), (receiver, "ball", "back", sender))
        nodes = [_node(*each, queue_size, environment) for each in names]
        for node, core in zip(nodes, chosen or (), strict=False):
            node["env"] = {**environment, "CORE": str(core)}
        (folder / "flow.yml").write_text(json.dumps({"nodes": nodes}))  # JSON is YAML
        _run([str(command), "run", "flow.yml"], folder)
        return json.loads(result.read_text())


def _node(
    name: str,
    input_name: str,
    output: str,
    source: str,
    queue_size: int,
    environment: Mapping[str, str],
) -> dict[str, Any]:
    return {
        "id": name,
        "path": str(PROGRAMS / f"dora_{name}.py"),
        "inputs": {input_name: {"source": f"{source}/{input_name}", "queue_size": queue_size}},
        "outputs": [output],
        "env": environment,
    }


def _run(command: list[str], folder: Path) -> None:
    """Run a dataflow to its end; it ends its nodes, and they end when it is gone."""
    environment = {**os.environ, "DORA_LOG_LEVEL": "warn"}
    # It starts "python" for its nodes: this one.
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    before = {*SHARED_MEMORY.glob("*.zenoh")}
    try:
        with running(command, environment, folder=folder) as process:
            answer(process, _END_S)
    finally:
        # It leaves its shared memory to be removed by the next one.
        for left in {*SHARED_MEMORY.glob("*.zenoh")} - before:
            left.unlink(missing_ok=True)
