"""The rover drives, is charged and tells how it fares, among plain ROS 2 programs."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest
from launching import EXAMPLES, start
from plain_programs import plain_program

from containers import require_containers
from neuros.backends.domain import choose_domain

ROVER = EXAMPLES / "6_outside/rover"
SOON = ("--set", "nodes.rover.parameters.low_battery=0.95")
LIMIT_S = 60.0


@pytest.mark.parametrize(
    "back_end",
    ["process", *(pytest.param(b, marks=pytest.mark.acceptance) for b in ("in-process", "docker"))],
)
def test_the_rover_drives_until_it_was_charged_twice(back_end: str, tmp_path: Path) -> None:
    if back_end == "docker":
        require_containers()
    with choose_domain(None, {}, False) as domain, contextlib.ExitStack() as stack:
        arguments = ("--backend", back_end, "-d", str(domain.id), *SOON)
        running = stack.enter_context(start(ROVER, *arguments, cwd=tmp_path))
        driver = stack.enter_context(plain_program(ROVER / "driver.py", domain.id))
        assert driver.stdout is not None
        # It is told what it was too late for.
        assert re.fullmatch(r"\d\.\d m: ready\n", driver.stdout.readline())
        stack.enter_context(plain_program(ROVER / "battery.py", domain.id))
        finished = running.finish(LIMIT_S)
        told = driver.stdout.readline()
    assert finished.exit_code == 0, finished.output
    assert finished.record["reason"] == "rover ended the project: charged 2 times"
    charged = [text for text in finished.said("rover") if "full again" in text]
    assert len(charged) == 2
    assert re.fullmatch(r"\d+\.\d m: charging, \d+ % were left\n", told)
