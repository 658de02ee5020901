"""No program of ours imports what lies in the current folder, or in the folder of a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from neuros.distribution import python_command
from tests.support.launching import BACKENDS

NEUROS = Path(sys.executable).with_name("neuros")
# Of NeuROS, of Python, and of others; each is imported by a process of a run, or to start one.
PLANTED = (
    *("neuros", "json", "runpy", "signal", "argparse", "subprocess", "multiprocessing", "typing"),
    *("rclpy", "numpy", "mujoco", "rosbags", "pip", "venv", "compileall", "rerun"),
)
# Plants in the run folder, too, and kills the recorder, which is started again at the end.
PLUGIN = """
import os, signal
from pathlib import Path
from neuros.hooks import neuros_initialise, neuros_tick
@neuros_initialise()
def plant(node):
    run = Path(os.environ["NEUROS_RUN_DIR"]).parent
    for name in {planted}:
        (run / f"{{name}}.py").write_text("open({mark!r}, 'a').write(__file__)")
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes().split(b"\\0")
        except OSError:
            continue
        if b"recorder" in command and os.fsencode(run) in command:
            os.kill(int(process.name), signal.SIGKILL)
            break
    else:
        raise RuntimeError("there is no recorder")
@neuros_tick(seconds=0.01)
def end(node):
    node.shutdown("planted")
"""


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    """What every planted module writes to when it runs."""
    return tmp_path / "was run"


@pytest.fixture
def planted(tmp_path: Path, mark: Path) -> Path:
    """A folder in which somebody has left modules."""
    folder = tmp_path / "planted"
    folder.mkdir()
    for name in PLANTED:
        (folder / f"{name}.py").write_text(f"open({str(mark)!r}, 'a').write(__file__)\n")
    return folder


@pytest.fixture
def project(tmp_path: Path, mark: Path) -> Path:
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "plugin.py").write_text(PLUGIN.format(planted=PLANTED, mark=str(mark)))
    node = {"name": "a", "container": "neuros_python", "plugin": "plugin.py"}
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    return folder


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize("module", ["neuros.cli", "pip", "venv", "compileall"])
def test_a_python_of_ours_imports_nothing_from_the_current_folder(
    planted: Path, mark: Path, module: str
) -> None:
    done = run(python_command(module, "--help"), planted)
    assert (done.returncode, mark.exists()) == (0, False), done.stderr
    assert "usage" in done.stdout.lower()


def test_python_finds_what_its_variables_name(tmp_path: Path, planted: Path) -> None:
    (tmp_path / "mine.py").write_text("print('mine')\n")
    done = subprocess.run(
        python_command("mine"),
        cwd=planted,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "mine\n"


def test_the_doctor_runs_nothing_of_the_current_folder(planted: Path, mark: Path) -> None:
    done = run([str(NEUROS), "doctor"], planted)
    assert "packets arrived" in done.stdout, done.stdout + done.stderr
    assert not mark.exists()


@pytest.mark.parametrize("backend", BACKENDS)
def test_nothing_runs_that_a_node_leaves_in_the_run_folder(
    planted: Path, project: Path, mark: Path, backend: str
) -> None:
    options = ["--backend", backend, "-o", "run", "-m", "--dashboard", "--record"]
    done = run([str(NEUROS), "launch", str(project), *options], planted)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (planted / "run" / "numpy.py").exists()
    assert not mark.exists(), mark.read_text()


@pytest.mark.parametrize("command", [["validate", "--import"], ["build", "-p"]])
def test_the_pythons_of_commands_run_nothing_of_the_current_folder(
    planted: Path, project: Path, mark: Path, command: list[str]
) -> None:
    done = run([str(NEUROS), *command, str(project)], planted)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not mark.exists(), mark.read_text()
