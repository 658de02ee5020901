"""The tutorial, done literally: its files are written and its commands run, in order."""

from __future__ import annotations

import os
import re
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from tutorial_files import files_of, steps

ROOT = Path(__file__).resolve().parents[2]
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
# Installing is tested by whoever runs this: the continuous integration has installed it so.
_INSTALLING = ("git clone", "cd neuros", "./install.py")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that looks like the checkout; examples can be changed in it."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in (".venv", "launch.py", "neuros", "schema", "workspace", "containers"):
        (folder / name).symlink_to(ROOT / name)
    subprocess.run(["cp", "-r", str(ROOT / "examples"), str(folder)], check=True)
    return folder


def run(command: str, folder: Path) -> str:
    """Run a line of the tutorial in the checkout; returns what it says."""
    done = subprocess.run(
        command,
        shell=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "NEUROS_GUI": "0"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout + done.stderr


def commands_of(step: str) -> list[str]:
    """The lines of all shell blocks, but for those that install."""
    lines = [line for text in blocks(step, "sh") for line in text.splitlines()]
    return [line for line in lines if not line.startswith(_INSTALLING)]


def blocks(step: str, language: str) -> list[str]:
    return [text for found, text in _BLOCK.findall(step) if found == language]


def write_files(step: str, folder: Path) -> None:
    for name, text in files_of(step).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, "utf-8")


def follow(step: str, folder: Path) -> str:
    """Do what one step says; returns all that its commands have said."""
    write_files(step, folder)
    return "".join(run(command, folder) for command in commands_of(step))


def shown(step: str) -> list[str]:
    """The lines that a step shows as output, up to where they depend on the moment."""
    return [line.partition("RMS")[0] for t in blocks(step, "text") for line in t.splitlines()]


def follow_first_six(folder: Path) -> None:
    first, *further = steps()[:6]
    assert follow(first, folder).count("[display]: It is ") == len(shown(first))
    for step in further:
        said = follow(step, folder)
        assert shown(step)
        assert not [line for line in shown(step) if line not in said]
    assert (folder / "runs" / "recorded" / "report" / "report.html").exists()


def follow_eighth(folder: Path) -> None:
    """The robot of one's own, up to where the browser takes over."""
    eighth = steps()[7].partition("### Watch it")[0]
    said = follow(eighth, folder)
    (line,) = shown(eighth)
    words = re.compile(re.sub(r"\d+\\\.\d", r"(\\d+\\.\\d)", re.escape(line)))
    found = words.search(said)
    assert found, said
    assert float(found[1]) < 1, "the lamp is 3 m across its circle"
    assert (folder / "runs" / "vehicle" / "plot" / "paths.png").stat().st_size > 1000


def test_the_steps_do_what_they_say(checkout: Path) -> None:
    with ThreadPoolExecutor() as side_by_side:  # the first waits for the clock, the last computes
        parts = [side_by_side.submit(each, checkout) for each in (follow_first_six, follow_eighth)]
    for part in parts:
        part.result()


@pytest.mark.acceptance
def test_the_seventh_changes_the_example(checkout: Path) -> None:
    seventh = steps()[6]
    plain, biased = commands_of(seventh)
    assert rms_deg(run(plain, checkout)) < 3
    _, before, after = blocks(seventh, "text")
    change(checkout / "examples" / "4_neurorobotics" / "whiskeye" / "snn.py", before, after)
    assert rms_deg(run(biased, checkout)) > 30


@pytest.mark.acceptance
def test_the_vehicle_keeps_to_real_time_where_a_tick_starts_its_steps(checkout: Path) -> None:
    eighth = steps()[7]
    write_files(eighth, checkout)
    plugin = checkout / "vehicle" / "vehicle.py"
    change(
        plugin, "import neuros_function, neuros_initialise", "import neuros_initialise, neuros_tick"
    )
    _, decorator = blocks(eighth, "text")
    change(
        plugin, '@neuros_function(inputs="wheels", outputs=["pose", "lamp", "light"])\n', decorator
    )
    said = run(commands_of(eighth)[-1], checkout)
    assert "dashboard: http://127.0.0.1:" in said
    factor = re.search(r"real-time factor ([\d.]+)", said)
    assert factor, said
    assert float(factor[1]) <= 1.01


def change(file: Path, before: str, after: str) -> None:
    """Replace the text that the tutorial names by the one that it shows."""
    text = file.read_text("utf-8")
    assert text.count(before) == 1
    file.write_text(text.replace(before, after), "utf-8")


def rms_deg(said: str) -> float:
    """The error of the heading that the visualiser has found, in degrees."""
    found = re.search(r"head-direction error: RMS ([\d.]+) deg", said)
    assert found, said
    return float(found[1])
