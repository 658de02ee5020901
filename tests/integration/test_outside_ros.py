"""Plain rclpy programs, in processes of their own, and a node that has to do with them."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest
from launching import Running, start
from plain_programs import plain_program

from containers import require_containers
from neuros.backends.domain import choose_domain

PROJECT = Path(__file__).parent / "outside_ros"
PROGRAM = PROJECT / "program.py"
LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
LIMIT_S = 60.0
MATCHED = ("fast heard: 1", "sure heard: 1", "latched heard: 1")
UNMATCHED = (
    "input 'strict': on /strict /program offers best_effort, but this input requires reliable",
    "output 'loose': on /loose /program requires reliable, but this output offers best_effort",
)


@pytest.mark.parametrize(
    "back_end",
    ["in-process", *(pytest.param(b, marks=pytest.mark.acceptance) for b in ("process", "docker"))],
)
def test_a_node_among_plain_ros_programs(back_end: str, tmp_path: Path) -> None:
    if back_end == "docker":
        require_containers()
    with (
        choose_domain(None, {}, False) as domain,
        plain_program(PROGRAM, domain.id, **LOCAL) as there,
    ):
        assert there.stdout is not None
        assert there.stdout.readline() == "here\n"
        arguments = ("--backend", back_end, "-d", str(domain.id))
        with start(PROJECT, *arguments, cwd=tmp_path) as running:
            for text in (*MATCHED, *UNMATCHED):
                running.wait_for(text, LIMIT_S)
            with plain_program(PROJECT / "late.py", domain.id, **LOCAL) as late:
                answer, _ = late.communicate(timeout=LIMIT_S)
            check_what_the_late_one_found(json.loads(answer))
            check_the_end(running)
        there.send_signal(signal.SIGINT)
        assert "heard" not in there.stdout.read(), "a best-effort output, by a reliable reader"


def check_what_the_late_one_found(found: dict[str, Any]) -> None:
    counts = found.pop("counts")
    assert found == {
        "states": ["ready with 1.5"],
        "greeting": "hello",
        "gain.p": 1.5,
        "limits": [1, 2],
        "described": 5,
        "late": 3,
        "set": [True, False],
    }
    # A hook that runs without pause and ROS's callbacks take turns, and never run at once.
    assert counts.pop("at_once") == 0
    assert all(count > 0 for count in counts.values()), counts
    assert counts["timer"] > 20
    assert counts["rounds"] > 20
    assert counts["set"] == 2


def check_the_end(running: Running) -> None:
    running.signal(signal.SIGINT)
    finished = running.finish()
    assert finished.exit_code == 130, finished.output
    assert "strict heard" not in finished.output
    assert finished.output.count("requires reliable") == 2, "each is said once"
