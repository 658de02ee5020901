"""Nodes without NeuROS (:mod:`benchmarks.programs.bare_nodes`), in one process or in several."""

from __future__ import annotations

import contextlib
import json
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.processes import program, ros_environment, running
from benchmarks.programs import MARK

Description = Mapping[str, Any]

_SETTLE_S = 0.3


def results(programs: Sequence[Sequence[Description]], measuring: Sequence[int]) -> list[Any]:
    """Run programs, each with its nodes, until those numbered in ``measuring`` have a result."""
    with begun(programs) as processes:
        return [json.loads(_line(processes[number])) for number in measuring]


@contextlib.contextmanager
def begun(
    programs: Sequence[Sequence[Description]],
) -> Iterator[Sequence[subprocess.Popen[str]]]:
    """Programs, each with its nodes, that have found each other and begun."""
    with contextlib.ExitStack() as stack:
        environment = stack.enter_context(ros_environment())
        processes = [
            stack.enter_context(running(program("bare_nodes", json.dumps(nodes)), environment))
            for nodes in programs
        ]
        for process in processes:
            _line(process)
        time.sleep(_SETTLE_S)  # a match on one side says nothing about the other
        for process in reversed(processes):  # who sends first is the first
            assert process.stdin is not None
            process.stdin.write("begin\n")
            process.stdin.flush()
        yield processes
        for process in processes:  # all at once, not one after the other
            assert process.stdin is not None
            process.stdin.close()


def _line(process: subprocess.Popen[str]) -> str:
    """The next line that the program itself has printed."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(MARK):
            return line.removeprefix(MARK)
    raise RuntimeError(f"{process.args!r} ended with exit code {process.wait()}")
