"""Nodes over dora-rs, if it is installed: ``./install.py --extras benchmark``."""

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
    chosen: Sequence[int] | None = None,
) -> Any:
    """Let two programs send each other ``ball`` and ``back``; returns what they found out.

    Args:
        sender, receiver: programs ``dora_<name>.py``.
        variables: of their environment.
        chosen: the cores of the two; dora's own process is not pinned. ``None``: nothing is.

    Raises:
        Unavailable: if dora-rs is not installed.
    """
    (result,) = run_all([sender], [receiver], variables, queue_size=1, chosen=chosen)
    return result


def run_all(
    senders: Sequence[str],
    receivers: Sequence[str],
    variables: Mapping[str, object],
    *,
    queue_size: int,
    chosen: Sequence[int] | None = None,
) -> list[Any]:
    """Let every sender send ``ball`` to every receiver, which answers it; returns all results.

    Args:
        senders, receivers: each a program, and a number where there are several of it.
        queue_size: packets that an input holds.

    Raises:
        Unavailable: if dora-rs is not installed.
    """
    command = Path(sys.executable).parent / "dora"
    if importlib.util.find_spec("dora") is None or not command.exists():
        raise Unavailable("dora-rs is not installed (./install.py --extras benchmark)")
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        folder = Path(name)
        # A receiver answers on an output for each sender, so that no other one hears it.
        nodes = [
            *(_node(s, {r: f"{r}/{s}" for r in receivers}, ["ball"], queue_size) for s in senders),
            *(_node(r, {s: f"{s}/ball" for s in senders}, senders, queue_size) for r in receivers),
        ]
        for node in nodes:
            result = folder / f"{node['id']}.json"
            node["env"] = {key: str(value) for key, value in variables.items()}
            node["env"] |= {"RESULT": str(result), "RECEIVERS": str(len(receivers))}
        for node, core in zip(nodes, chosen or (), strict=False):
            node["env"]["CORE"] = str(core)
        (folder / "flow.yml").write_text(json.dumps({"nodes": nodes}))  # JSON is YAML
        _run([str(command), "run", "flow.yml"], folder)
        return [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]


def _node(
    name: str, inputs: Mapping[str, str], outputs: Sequence[str], queue_size: int
) -> dict[str, Any]:
    return {
        "id": name,
        "path": str(PROGRAMS / f"dora_{name.rstrip('0123456789')}.py"),
        "inputs": {key: {"source": s, "queue_size": queue_size} for key, s in inputs.items()},
        "outputs": [*outputs],
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
