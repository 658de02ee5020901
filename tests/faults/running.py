"""Runs one cell of the fault matrix as a user does, and looks at what came of it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from tests.endings import dead_shared_memory
from tests.launching import Running, start

from .cells import Cell, Kind

ENDS_WITHIN_S = 6.0
DRAINS_WITHIN_S = 5.0
DURATION_S = 1.5
_NODES = Path(__file__).parent / "nodes"
_STRIKES_WITHIN_S = 30.0
_LOOKS_FOR_S = 1.0
_GIVES_UP_AFTER_S = 25.0
_POLL_S = 0.02
_NUMBER = "std_msgs/msg/Int64"


@dataclass(frozen=True)
class Outcome:
    """What came of a cell.

    Attributes:
        said: the last line of the launcher, which names the cause.
        took_s: from the fault, or from when the end was due, to the end of the launcher.
        bag: ``complete``, ``repaired``, or what is wrong with it.
        left: what has outlived the run.
        problems: where that is not what must be.
    """

    cell: Cell
    exit_code: int
    said: str
    took_s: float
    bag: str
    left: list[str]
    output: str
    problems: list[str] = field(default_factory=list)


def run(cell: Cell, folder: Path, *, flood_bytes: int) -> Outcome:
    """Run a cell in an empty folder and judge it.

    Args:
        flood_bytes: how much ``flood_output`` writes.
    """
    mark = uuid.uuid4().hex
    _write_project(cell, folder, mark, flood_bytes)
    temporary = folder / "tmp"
    temporary.mkdir()
    since_s = time.time()
    started = start(
        folder / "project.json",
        *("--backend", cell.backend, "--duration", str(DURATION_S), "-r", "-o", "run"),
        cwd=folder,
        TMPDIR=str(temporary),
        FAULT_MARK=mark,
    )
    with started as running:
        due_s = _end_is_due(cell, running, folder / "run", mark)
        is_over = _read_to_end(running, time.monotonic() + _GIVES_UP_AFTER_S)
        took_s = time.monotonic() - due_s
    exit_code = running.process.returncode
    record = _record(folder / "run")
    if cell.ends_by_itself and record:
        # Both count from the first hook.
        took_s = record["wall_s"] - DURATION_S
    left = _left(mark, since_s, temporary)
    lines = [line for line in running.output.splitlines() if line.strip()]
    outcome = Outcome(
        cell,
        exit_code,
        lines[-1][:400] if lines else "",
        took_s,
        _bag(folder / "run"),
        left,
        running.output,
    )
    if not is_over:
        outcome.problems.append(f"not ended {_GIVES_UP_AFTER_S:g} s after the fault")
    outcome.problems.extend(_problems(outcome, record))
    return outcome


def _write_project(cell: Cell, folder: Path, mark: str, flood_bytes: int) -> None:
    environment = {
        "FAULT": cell.fault,
        "PLACE": cell.place,
        "FAULT_BYTES": str(flood_bytes),
        "FAULT_MARK": mark,
    }
    ports = {
        "source": {"outputs": [{"name": "number", "type": _NUMBER}]},
        "victim": {
            "inputs": [{"name": "number", "type": _NUMBER}],
            "outputs": [{"name": "passed", "type": _NUMBER}],
        },
        "sink": {"inputs": [{"name": "number", "type": _NUMBER}]},
    }
    nodes = []
    for name, declared in ports.items():
        (folder / f"{name}.py").write_text((_NODES / f"{name}.py").read_text())
        nodes.append(
            {
                "name": name,
                "container": "neuros_python",
                "plugin": f"{name}.py",
                "environment": environment,
                **declared,
            }
        )
    path = [("source", "number", "victim", "number"), ("victim", "passed", "sink", "number")]
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    connections = [{**dict(zip(keys, hop, strict=True)), "discard_limit": 0} for hop in path]
    project = {"nodes": nodes, "connections": connections}
    (folder / "project.json").write_text(json.dumps(project, indent=1))


def _end_is_due(cell: Cell, running: Running, run_folder: Path, mark: str) -> float:
    """Wait for the fault; returns when the end is due by the rules, on the monotonic clock."""
    struck = run_folder / "victim" / "struck"
    deadline_s = time.monotonic() + _STRIKES_WITHIN_S
    while not struck.exists() or not struck.read_text():
        if not running.read(_POLL_S) and running.process.poll() is not None:
            break
        if time.monotonic() > deadline_s:
            return time.monotonic()
    struck_s = float(struck.read_text()) if struck.exists() else time.monotonic()
    if cell.backend == "docker":
        _strike_from_outside(cell.fault, mark)
    if cell.needs_interrupt:
        _read_to_end(running, struck_s + _LOOKS_FOR_S)
        running.signal(signal.SIGINT)
        return time.monotonic()
    return struck_s


def _strike_from_outside(fault: str, mark: str) -> None:
    """The faults that process 1 of a container cannot do to itself."""
    if fault not in ("kill", "stop_and_continue"):
        return
    for process in psutil.process_iter(["environ"]):
        environ = process.info["environ"] or {}
        node = Path(environ.get("NEUROS_RUN_DIR", "")).name
        if (environ.get("FAULT_MARK"), node) != (mark, "victim"):
            continue
        if fault == "kill":
            process.kill()
        else:
            process.suspend()
            time.sleep(1.0)
            process.resume()
        return


def _read_to_end(running: Running, deadline_s: float) -> bool:
    """Read until the launcher has ended; False at the deadline."""
    while running.process.poll() is None:
        if time.monotonic() > deadline_s:
            return False
        running.read(_POLL_S)
    while running.read(_POLL_S):
        pass
    return True


def _left(mark: str, since_s: float, temporary: Path) -> list[str]:
    """What has outlived a run: processes, shared memory, temporary files."""
    found = []
    for process in psutil.process_iter(["pid", "name", "environ"]):
        if (process.info["environ"] or {}).get("FAULT_MARK") == mark:
            found.append(f"process {process.info['pid']} ({process.info['name']})")
    found += dead_shared_memory(since_s)
    return found + [str(path.relative_to(temporary)) for path in temporary.rglob("*")]


def _bag(run_folder: Path) -> str:
    if not (run_folder / "bag").is_dir():
        return "none"
    info = _neuros("bag", "info", str(run_folder))
    if info.returncode == 0:
        return "complete"
    repair = _neuros("bag", "repair", str(run_folder))
    info = _neuros("bag", "info", str(run_folder))
    return "repaired" if info.returncode == 0 else (repair.stdout + info.stdout).strip()


def _neuros(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "neuros.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        timeout=60,
    )


def _problems(outcome: Outcome, record: dict[str, Any]) -> list[str]:
    cell, found = outcome.cell, []
    if outcome.exit_code not in cell.exit_codes:
        allowed = " or ".join(map(str, cell.exit_codes))
        found.append(f"exit code {outcome.exit_code}, not {allowed}")
    drains_s = DRAINS_WITHIN_S if cell.ends_by_itself and not cell.is_survived else 0.0
    if outcome.took_s > ENDS_WITHIN_S + drains_s:
        found.append(f"ended after {outcome.took_s:.1f} s")
    if outcome.exit_code == 1 and "victim" not in outcome.said:
        found.append("the last line does not name the node")
    is_silent = cell.fault == "sys_exit" and cell.place == "thread"  # Python ends just the thread
    if cell.kind is Kind.RAISES and not is_silent and "Traceback" not in outcome.output:
        found.append("no traceback")
    found += [f"left: {each}" for each in outcome.left]
    if outcome.bag not in ("complete", "repaired"):
        found.append(f"bag: {outcome.bag}")
    if not record:
        found.append("run.json is missing, or broken")
    elif record["exit_code"] != outcome.exit_code:
        found.append(f"run.json has exit code {record['exit_code']}")
    return found


def _record(run_folder: Path) -> dict[str, Any]:
    """The content of ``run.json``, empty if there is none."""
    try:
        record: dict[str, Any] = json.loads((run_folder / "run.json").read_text())
    except (OSError, ValueError):
        return {}
    return record
