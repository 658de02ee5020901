"""A trial: a small project in a folder of its own, run as a user does, and what came of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from endings import dead_shared_memory, stale_locks
from launching import LAUNCH, Running, start

ENDS_WITHIN_S = 6.0
GIVES_UP_AFTER_S = 25.0
POLL_S = 0.02
_NODES = Path(__file__).parent / "nodes"
_STRIKES_WITHIN_S = 30.0
_OTHERS_CLEAN_UP_S = 3.0
_NUMBER = "std_msgs/msg/Int64"
_MARK = "FAULT_MARK"
_CONTAINER_LABEL = "neuros.run_folder"


@dataclass(frozen=True)
class Place:
    """Where the outcome of a trial stands in the tables.

    ``begins``: its table is made anew from here on.
    """

    table: str
    row: str
    column: str
    begins: bool = False

    def __str__(self) -> str:
        return f"{self.row} at {self.column}, {self.table}"


@dataclass(frozen=True)
class Expected:
    """What must come of a trial.

    Attributes:
        exit_codes: those that are right.
        says: is in what is printed, in one of its lines.
        last_says: is in the last line.
        within_s: from when the end is due to the end of the launcher, and of all that it started.
        has_record: whether ``run.json`` is in the run folder; its launcher may have been killed.
        has_bag: whether there must be a bag; if there is one, it is complete or can be repaired.
        has_traceback: ``None``: there may be one.
    """

    exit_codes: tuple[int, ...] = (0,)
    says: str = ""
    last_says: str = ""
    within_s: float = ENDS_WITHIN_S
    has_record: bool = True
    has_bag: bool = True
    has_traceback: bool | None = False


@dataclass
class Outcome:
    """What came of a trial.

    Attributes:
        said: the last line of the launcher, which names the cause.
        took_s: from when the end was due to the end of the launcher, and of what it leaves behind.
        bag: ``complete``, ``repaired``, ``none``, or what is wrong with it.
        problems: where that is not what must be.
        is_late: it took longer than it may, or the machine was too busy.
    """

    place: Place
    exit_code: int
    said: str
    took_s: float
    bag: str
    output: str
    record: dict[str, Any]
    problems: list[str] = field(default_factory=list)
    is_late: bool = False

    @property
    def is_well(self) -> bool:
        return not self.problems and not self.is_late

    @property
    def shown(self) -> str:
        """In a table."""
        text = f"{self.exit_code}, {max(0.0, self.took_s):.1f} s"
        problems = f": {'; '.join(self.problems)}" if self.problems else ""
        return text if self.is_well else f"**{text}{problems}**"

    def __str__(self) -> str:
        problems = "; ".join([*self.problems, *["late"] * self.is_late]) or "ok"
        return (
            f"{self.place!s:55} {self.exit_code:4} {self.took_s:5.1f} s {self.bag:9} {problems}\n"
            f"    {self.said}"
        )


class Trial:
    """A chain of three nodes, in whose second one a fault strikes.

    Args:
        folder: an empty one.
        fault, strikes_at: for ``nodes/victim.py``, as its functions and places are called.
        size: bytes, for faults that write.
        run_folder: where the run goes, ``folder/run`` unless it is elsewhere.
    """

    def __init__(
        self,
        folder: Path,
        fault: str,
        strikes_at: str,
        size: int = 0,
        run_folder: Path | None = None,
    ) -> None:
        self.folder = folder
        self.run_folder = run_folder or folder / "run"
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        self.mark = uuid.uuid4().hex
        self._since_s = time.time()
        environment = {
            "FAULT": fault,
            "PLACE": strikes_at,
            "FAULT_BYTES": str(size),
            _MARK: self.mark,
        }
        _write_project(folder, environment)

    def start(
        self,
        backend: str,
        *arguments: str,
        duration_s: float,
        program: Sequence[str] = LAUNCH,  # one that is forked does not have our mark for all to see
        **more: Any,
    ) -> Running:
        """Start the run, recorded; ``more`` goes to :func:`tests.support.launching.start`."""
        return start(
            self.folder / "project.json",
            *("--backend", backend, "--duration", f"{duration_s:g}"),
            *("-r", "-o", str(self.run_folder), *arguments),
            cwd=self.folder,
            program=program,
            **{"TMPDIR": str(self.temporary), _MARK: self.mark, **more},
        )

    def await_strike(self, running: Running) -> float:
        """Wait for the fault; returns when it struck, on the monotonic clock.

        Returns the time now if the run has ended before. Raises ``TimeoutError``.
        """
        deadline_s = time.monotonic() + _STRIKES_WITHIN_S
        while (struck_s := self.struck_s) is None:
            if not running.read(POLL_S):
                if running.process.poll() is not None:
                    return time.monotonic()
                time.sleep(POLL_S)  # its output may be closed
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"no fault struck in {_STRIKES_WITHIN_S:g} s")
        return struck_s

    @property
    def struck_s(self) -> float | None:
        """When the fault struck, on the monotonic clock; ``None``: it has not."""
        try:
            text = (self.run_folder / "victim" / "struck").read_text()
        except OSError:
            return None
        return float(text) if text else None

    def processes(self) -> Iterator[psutil.Process]:
        """All of the run, with its launcher."""
        for process in psutil.process_iter(["environ", "name"]):
            if (process.info["environ"] or {}).get(_MARK) == self.mark:
                yield process

    def outcome(
        self,
        place: Place,
        running: Running,
        due_s: float,
        expected: Expected,
        *,
        is_left: Callable[[], Sequence[str]] = lambda: (),
    ) -> Outcome:
        """Read the run to its end, and judge it.

        Args:
            due_s: when its end is due, on the monotonic clock.
            is_left: what else is left of it.
        """
        is_over = read_to_end(running, time.monotonic() + GIVES_UP_AFTER_S)
        took_s = time.monotonic() - due_s
        # Where the launcher was killed, its guardian cleans up after it.
        until_s = time.monotonic() if expected.has_record else due_s + GIVES_UP_AFTER_S
        left = self._left(until_s, is_left)
        if not expected.has_record:
            took_s = time.monotonic() - due_s
        lines = [line for line in running.output.splitlines() if line.strip()]
        outcome = Outcome(
            place,
            running.process.returncode if is_over else -1,
            lines[-1][:400] if lines else "",
            took_s,
            _bag(self.run_folder),
            running.output,
            _record(self.run_folder),
        )
        if not is_over:
            outcome.problems.append(f"not ended after {GIVES_UP_AFTER_S:g} s")
        outcome.problems += [f"left: {each}" for each in left]
        outcome.problems += _problems(outcome, expected)
        outcome.is_late = took_s > expected.within_s
        return outcome

    def _left(self, until_s: float, is_left: Callable[[], Sequence[str]]) -> list[str]:
        """What has outlived the run, at ``until_s`` at the latest."""
        while True:
            found = [f"process {p.pid} ({p.info['name']})" for p in self.processes()]
            found += [str(path.relative_to(self.folder)) for path in self.temporary.rglob("*")]
            found += [path.name for path in self.run_folder.glob("control.sock")]
            found += is_left()
            if not found or time.monotonic() > until_s:
                break
            time.sleep(POLL_S)
        # Another run of this machine may be about to clean up after nodes of its own.
        until_s = time.monotonic() + _OTHERS_CLEAN_UP_S
        while dead := [*dead_shared_memory(self._since_s), *stale_locks()]:
            if time.monotonic() > until_s:
                break
            time.sleep(POLL_S)
        return found + dead


def containers_of(folder: Path, address: str | None = None) -> list[str]:
    """Containers of runs below a folder; ``address`` of an engine, unless it is the usual one."""
    from neuros.backends.docker.engine import connect

    engine = connect(os.environ if address is None else {"DOCKER_HOST": address})
    try:
        found = engine.api.containers(all=True, filters={"label": _CONTAINER_LABEL})
        return [
            f"container {each['Names'][0]}"
            for each in found
            if Path(each["Labels"][_CONTAINER_LABEL]).is_relative_to(folder)
        ]
    finally:
        engine.close()


def read_to_end(running: Running, deadline_s: float) -> bool:
    """Read until the launcher has ended; False at the deadline."""
    while running.process.poll() is None:
        if time.monotonic() > deadline_s:
            return False
        if not running.read(POLL_S):
            time.sleep(POLL_S)
    while running.read(POLL_S):
        pass
    return True


def _write_project(folder: Path, environment: dict[str, str]) -> None:
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


def _record(run_folder: Path) -> dict[str, Any]:
    """The content of ``run.json``, empty if there is none."""
    try:
        record: dict[str, Any] = json.loads((run_folder / "run.json").read_text())
    except (OSError, ValueError):
        return {}
    return record


def _problems(outcome: Outcome, expected: Expected) -> Iterator[str]:
    if outcome.exit_code not in expected.exit_codes:
        yield f"exit code {outcome.exit_code}, not {' or '.join(map(str, expected.exit_codes))}"
    if expected.says not in outcome.output:
        yield f"does not say '{expected.says}'"
    if expected.last_says not in outcome.said:
        yield f"the last line does not say '{expected.last_says}'"
    if expected.has_traceback is not None and expected.has_traceback is not (
        "Traceback" in outcome.output
    ):
        yield "no traceback" if expected.has_traceback else "a traceback"
    if outcome.bag not in ("complete", "repaired") and (expected.has_bag or outcome.bag != "none"):
        yield f"bag: {outcome.bag}"
    if outcome.record and outcome.record["exit_code"] != outcome.exit_code:
        yield f"run.json has exit code {outcome.record['exit_code']}"
    elif expected.has_record and not outcome.record:
        yield "run.json is missing, or broken"
