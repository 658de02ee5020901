"""The tutorial, done literally: its files are written and its commands run, in order."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "tutorial.md"
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_FILE_NAMES = {"json": "first/project.json", "xml": "first/robot.xml"}
# Installing is tested by whoever runs this: the continuous integration has installed it so.
_INSTALLING = ("git clone", "cd neuros", "./install.py")


def steps() -> list[str]:
    """The text of each step."""
    return re.split(r"^## ", PAGE.read_text("utf-8"), flags=re.MULTILINE)[1:8]


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that looks like the checkout; examples can be changed in it."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in (".venv", "launch.py", "neuros", "schema", "workspace", "containers"):
        (folder / name).symlink_to(ROOT / name)
    subprocess.run(["cp", "-r", str(ROOT / "examples"), str(folder)], check=True)
    (folder / "first").mkdir()
    return folder


def blocks(step: str) -> Iterator[tuple[str, str]]:
    yield from _BLOCK.findall(step)


def run(command: str, folder: Path) -> str:
    """Run a line of the tutorial in the checkout; returns what it says."""
    done = subprocess.run(
        command,
        shell=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "NEUROS_GUI": "0"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout + done.stderr


def follow(step: str, folder: Path) -> str:
    """Do what one step says; returns all that its commands have said."""
    said = ""
    for language, text in blocks(step):
        if language == "python":
            name = re.match(r"# (\S+)\n", text)
            assert name, "a plugin begins with its file's name"
            (folder / name[1]).write_text(text, "utf-8")
        elif language in _FILE_NAMES:
            (folder / _FILE_NAMES[language]).write_text(text, "utf-8")
        elif language == "sh":
            for command in text.splitlines():
                if not command.startswith(_INSTALLING):
                    said += run(command, folder)
    return said


def shown(step: str) -> list[str]:
    """The lines that a step shows as output, up to where they depend on the moment."""
    texts = [text for language, text in blocks(step) if language == "text"]
    return [line.partition("RMS")[0] for text in texts for line in text.splitlines()]


def test_the_first_six_steps_do_what_they_say(checkout: Path) -> None:
    first, second, third, fourth, fifth, sixth, _ = steps()
    assert follow(first, checkout).count("[display]: It is ") == len(shown(first))
    assert "valid: 1 node, 0 connections" in follow(second, checkout)
    for step in (third, fourth, fifth):
        said = follow(step, checkout)
        assert shown(step)
        assert not [line for line in shown(step) if line not in said]
    follow(sixth, checkout)
    assert (checkout / "runs" / "recorded" / "report" / "report.html").exists()


@pytest.mark.acceptance
def test_the_seventh_changes_the_example(checkout: Path) -> None:
    seventh = steps()[6]
    plain, biased = commands_of(seventh)
    assert rms_deg(run(plain, checkout)) < 3
    change(seventh, checkout)
    assert rms_deg(run(biased, checkout)) > 30


def commands_of(step: str) -> list[str]:
    return [text.strip() for language, text in blocks(step) if language == "sh"]


def change(step: str, folder: Path) -> None:
    """Replace the line that the tutorial names by the one that it shows."""
    before, after = [text for language, text in blocks(step) if language == "text"][1:3]
    plugin = folder / "examples" / "4_neurorobotics" / "whiskeye" / "snn.py"
    text = plugin.read_text("utf-8")
    assert text.count(before) == 1
    plugin.write_text(text.replace(before, after), "utf-8")


def rms_deg(said: str) -> float:
    """The error of the heading that the visualiser has found, in degrees."""
    found = re.search(r"head-direction error: RMS ([\d.]+) deg", said)
    assert found, said
    return float(found[1])
