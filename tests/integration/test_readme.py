"""What README.md shows is what happens."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def blocks_of(language: str) -> list[str]:
    """The code blocks of that language in README.md."""
    text = (ROOT / "README.md").read_text("utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("backend", ["process", "in-process"])
def test_the_example_prints_what_is_shown(tmp_path: Path, backend: str) -> None:
    for name, language in (("count.py", "python"), ("project.json", "json")):
        (block,) = blocks_of(language)
        (tmp_path / name).write_text(block, "utf-8")
    (expected,) = blocks_of("text")
    done = subprocess.run(
        [sys.executable, ROOT / "launch.py", "project.json", "--backend", backend],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = re.findall(r"\[(?:alice|bob)\]: I heard .*\n", done.stdout + done.stderr)
    assert "".join(said) == expected


def test_the_continuous_integration_runs_all_commands() -> None:
    first, package, second = (block.strip() for block in blocks_of("sh"))
    assert second in (ROOT / ".ci" / "run").read_text("utf-8")
    on_a_bare_machine = (ROOT / ".ci" / "bare").read_text("utf-8")
    assert f"'{first}'" in on_a_bare_machine
    assert f"'{second}'" in on_a_bare_machine
    for command in package.splitlines():
        assert command.split("'")[-1].removesuffix(" --dashboard") in on_a_bare_machine


def test_it_fits_on_one_screen() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 80
