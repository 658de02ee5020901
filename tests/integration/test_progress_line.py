"""The progress of a real run: on a terminal a line below all others, else plain lines."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
from api_projects import COUNTER, dice
from launching import launch

TALKATIVE = COUNTER.replace("if len(seen) == 1:", "if len(seen) % 200 == 0:").replace(
    "== 10", "== 0"
)
SLOW = """
from neuros.hooks import neuros_tick
@neuros_tick(seconds=0.005, outputs="eyes")
def throw(node):
    return node.make_packet("eyes")
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """200 packets per second, and a record in the log for every 200."""
    made = dice(tmp_path, TALKATIVE)
    (made / "thrower.py").write_text(SLOW)
    return made


def on_terminal(*arguments: str, cwd: Path) -> str:
    """All that a run writes to a terminal of 120 columns."""
    reader, terminal = pty.openpty()
    environment = {**os.environ, "COLUMNS": "120", "TERM": "xterm", "NO_COLOR": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "neuros.cli", "launch", *arguments],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        cwd=cwd,
        env=environment,
    )
    os.close(terminal)
    output = b""
    while True:
        try:
            data = os.read(reader, 1 << 16)
        except OSError:  # the terminal was closed by the last that had it
            break
        output += data
    os.close(reader)
    assert process.wait(30) == 0, output
    return output.decode()


def test_on_a_terminal_the_line_stays_below_what_nodes_log(project: Path) -> None:
    output = on_terminal(str(project), "--backend", "in-process", "--duration", "3", cwd=project)
    drawn = re.findall(r"\r\x1b\[K *(\d+)%\|[^|]*\| ([^\r\n]*)", output)
    shares = [int(share) for share, _ in drawn]
    assert shares == sorted(shares)
    assert shares[-1] > 50
    assert any("packets/s, 0 discarded, 0:0" in text for _, text in drawn)
    rest = re.sub(r" *\d+%\|[^\r\n]*", "", output)
    shown = [line for line in rest.replace("\r\x1b[K", "").splitlines() if "[counter]" in line]
    assert len(shown) >= 2
    assert all(re.fullmatch(r"\[INFO\] \[[\d.]+\] \[counter\]: counting", line) for line in shown)
    assert "%|" not in output.partition("connection ")[2], "the line is gone when it is over"


def test_without_a_terminal_there_are_plain_records_and_few_of_them(project: Path) -> None:
    run = launch(project, "--backend", "in-process", "--duration", "1", cwd=project)
    assert run.exit_code == 0
    assert "%|" not in run.output
    assert "packets/s" not in run.output, "the first after ten seconds"


def test_it_can_be_switched_off(project: Path) -> None:
    arguments = (str(project), "--backend", "in-process", "--duration", "1", "--no-progress")
    assert "%|" not in on_terminal(*arguments, cwd=project)
