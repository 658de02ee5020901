"""Ctrl+C at every tenth of a second of a run, once, twice and ten times."""

from __future__ import annotations

import itertools
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from launching import REPOSITORY, Running

from .trials import POLL_S, Expected, Outcome, Place, Trial, containers_of

COUNTS = (1, 2, 10)
STEP_S = 0.1
_DURATION_S = 1.0
_LATEST_S = 30.0
_BETWEEN_S = 0.02
_GIVEN_UP = "the bag is not complete (it was not waited for): neuros bag repair "
_OF_PYTHON = (130, 1, -int(signal.SIGINT))


@dataclass(frozen=True)
class Interrupt:
    """So many times Ctrl+C, so long after the start."""

    count: int
    at_s: float
    backend: str

    @property
    def place(self) -> Place:
        """Where it stands in the tables."""
        is_first = self.count == COUNTS[0] and self.at_s == 0
        table = f"Ctrl+C, {self.backend}"
        return Place(table, f"{self.at_s:.1f} s", f"{self.count} x", begins=is_first)

    def __str__(self) -> str:
        return str(self.place)


def interrupts(
    backend: str, run: Callable[[Interrupt], Outcome], step_s: float
) -> Iterator[Outcome]:
    """Run all moments of a run on a back end, until it has ended by itself before."""
    for count in COUNTS:
        for tenth in itertools.count():
            outcome = run(Interrupt(count, tenth * step_s, backend))
            yield outcome
            if outcome.exit_code == 0 and "ctrl+c" not in outcome.output.lower():
                break
            if tenth * step_s > _LATEST_S:
                raise RuntimeError(f"a run of {_DURATION_S:g} s takes longer than {_LATEST_S:g} s")


def run(interrupt: Interrupt, folder: Path) -> Outcome:
    """Interrupt a run in an empty folder, and judge what comes of that."""
    trial = Trial(folder, "pass_by", "function")
    began_s = time.monotonic()
    program = (sys.executable, "-S", str(REPOSITORY / "launch.py"))
    with trial.start(interrupt.backend, duration_s=_DURATION_S, program=program) as running:
        while time.monotonic() < began_s + interrupt.at_s and running.process.poll() is None:
            running.read(min(POLL_S, max(0.0, began_s + interrupt.at_s - time.monotonic())))
        is_known = _is_known_to_neuros(running.process.pid)
        is_over = "s are over" in running.output
        for _ in range(interrupt.count):
            _interrupt(running)
            time.sleep(_BETWEEN_S)
        struck_s = time.monotonic()
        outcome = trial.outcome(
            interrupt.place,
            running,
            struck_s,
            _expected(interrupt, is_known=is_known, is_over=is_over),
            is_left=lambda: containers_of(folder) if interrupt.backend == "docker" else (),
        )
    if outcome.exit_code == 4 and _GIVEN_UP not in outcome.output:
        outcome.problems.append("exit code 4, and not because its bag was not waited for")
    return outcome


def _interrupt(running: Running) -> None:
    """As a terminal does: the whole group of processes gets it."""
    if running.process.poll() is None:
        os.killpg(running.process.pid, signal.SIGINT)


def _expected(interrupt: Interrupt, *, is_known: bool, is_over: bool) -> Expected:
    if not is_known:  # Python answers, or nothing is there any more that could
        return Expected((*_OF_PYTHON, 0), has_record=False, has_bag=False, has_traceback=None)
    if is_over:  # whoever interrupts it twice may have given up waiting for the bag
        return Expected((0, 130) if interrupt.count == 1 else (0, 130, 4))
    # It may have come to its end by itself between the look and the signal.
    return Expected((130, 0) if interrupt.at_s > _DURATION_S else (130,), has_bag=False)


def _is_known_to_neuros(pid: int) -> bool:
    """Whether a process has come to the first line of NeuROS: it blocks Ctrl+C, or heeds SIGHUP."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    masks = dict(re.findall(r"(SigBlk|SigCgt):\s*([0-9a-f]+)", status))

    def has(mask: str, number: int) -> bool:
        return bool(int(masks.get(mask, "0"), 16) >> (number - 1) & 1)

    return has("SigBlk", signal.SIGINT) or has("SigCgt", signal.SIGHUP)
