"""Nothing that somebody else wrote does anything to the terminal that a command prints to."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from neuros.cli.main import main

NASTY = "a\x1b]0;pwn\x07\x1b[2J\x9b3J\x1b[31mb\rc\x08"
SPELT = r"a\x1b]0;pwn\x07\x1b[2J\x9b3J"
NEUROS = [sys.executable, "-m", "neuros.cli"]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with such text wherever there is room for some."""
    folder = tmp_path / "project \x1b[2J"
    folder.mkdir()
    (folder / "sink.py").write_text(
        "from neuros.hooks import neuros_function\n"
        "@neuros_function(inputs='inp')\n"
        "def take(node, inp): pass\n"
    )
    node = {
        "name": "n",
        "container": "neuros_python",
        "plugin": "sink.py",
        "environment": {"NASTY": NASTY},
        "inputs": [{"name": "inp", "type": "std_msgs/msg/Int32"}],
    }
    content = {"description": NASTY, "nodes": [node], "connections": []}
    (folder / "project.json").write_text(json.dumps(content))
    return folder


def harmless(text: str) -> bool:
    return all(each.isprintable() or each in "\n\t" for each in text)


@pytest.mark.parametrize(
    "command",
    [
        ["graph", "{project}"],
        ["validate", "{project}"],
        ["validate", "{project}", "--set", f"nodes.n.environment.{NASTY}=1"],
        ["launch", "{project}", "--dry-run"],
        ["launch", "{project}", "--backend", NASTY],
        ["convert", f"{NASTY}.urdf"],
        ["report", NASTY],
        ["verify", NASTY, NASTY],
        ["bag", "info", NASTY],
        ["logs", NASTY],
        ["example", NASTY],
        [NASTY],
    ],
    ids=lambda command: " ".join(command).encode("ascii", "backslashreplace").decode()[:40],
)
def test_no_command_prints_control_characters(project: Path, command: list[str]) -> None:
    words = [word.format(project=project) if "{" in word else word for word in command]
    done = subprocess.run([*NEUROS, *words], capture_output=True, text=True, timeout=60)
    assert harmless(done.stdout + done.stderr), done
    assert "Traceback" not in done.stderr


def test_what_is_spelt_out_can_still_be_read(project: Path) -> None:
    done = subprocess.run(
        [*NEUROS, "graph", str(project)], capture_output=True, text=True, timeout=60, check=True
    )
    assert SPELT in done.stdout


def test_on_a_terminal_colours_stay_and_all_else_is_spelt_out(project: Path) -> None:
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm"}
    environment.pop("NO_COLOR", None)
    with subprocess.Popen(
        [*NEUROS, "graph", str(project)], stdout=theirs, stderr=theirs, env=environment
    ) as process:
        os.close(theirs)
        seen = b""
        try:
            while data := os.read(ours, 65536):
                seen += data
        except OSError:  # the other end is closed
            pass
        os.close(ours)
    assert process.returncode == 0
    text = seen.decode().replace("\r\n", "\n")
    assert SPELT + "\x1b[31m" in text
    assert harmless(text.replace("\x1b[31m", ""))


def test_python_programs_are_not_filtered_after_a_command(
    capsys: pytest.CaptureFixture[str],
) -> None:

    stream = sys.stdout
    assert main(["example"]) == 0
    assert sys.stdout is stream
