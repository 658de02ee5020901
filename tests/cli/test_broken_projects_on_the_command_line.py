"""Every kind of broken project: all its problems, exit code 3, and nothing is started.

What the problems say is tested case by case in ``tests/project``.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from neuros.cli.main import main

BROKEN = Path(__file__).resolve().parents[1] / "project" / "broken"
CASES = sorted(BROKEN.glob("[0-9]*.json"))


@pytest.mark.parametrize("command", ["launch", "validate"])
def test_every_problem_is_listed_and_nothing_is_started(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(BROKEN)
    before = (sorted(BROKEN.iterdir()), _children())
    for case in CASES:
        assert main([command, case.name]) == 3, case.name
        output = capsys.readouterr()
        assert output.out == ""
        *problems, verdict = [
            line for line in output.err.splitlines() if not line.startswith("warning: ")
        ]
        assert "\n".join(problems) + "\n" == case.with_suffix(".expected").read_text("utf-8")
        count = verdict.partition(" ")[0]
        assert verdict == f"{count} problem{'' if count == '1' else 's'}; nothing was started"
        assert int(count) >= 1
    assert (sorted(BROKEN.iterdir()), _children()) == before


def test_names_do_nothing_to_a_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "pro\x1b[2Jject.json"
    node = {
        "name": "a\x1b[31m",
        "container": "c\x1b]0;title\x07",
        "plugin": "p\x9b5m.py",
        "\x1b[5m": 1,
    }
    file.write_text(json.dumps({"nodes": [node], "connections": []}))
    assert main(["validate", str(file)]) == 3
    assert main(["launch", str(file)]) == 3
    said = capsys.readouterr().err
    assert "name: 'a\\x1b[31m' is not allowed" in said
    assert all(character.isprintable() or character == "\n" for character in said)


def _children() -> list[str]:
    """Processes that this one has started."""
    tasks = Path(f"/proc/{os.getpid()}/task").iterdir()
    return sorted(pid for task in tasks for pid in (task / "children").read_text().split())
