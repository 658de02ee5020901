"""The command ``neuros``: the script that is installed, Ctrl+C while it starts, completion."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "neuros/cli/script/neuros"


def installed(folder: Path, python: str) -> Path:
    """The script in a folder, beside a program ``python3``."""
    folder.mkdir()
    script = folder / "neuros"
    script.write_bytes(SCRIPT.read_bytes())
    (folder / "python3").write_text(f"#!/bin/sh\n{python}\n")
    for file in (script, folder / "python3"):
        file.chmod(0o755)
    return script


def test_the_python_beside_the_script_runs_it(tmp_path: Path) -> None:
    script = installed(tmp_path / "bin", 'echo "$@"')
    link = tmp_path / "neuros"
    link.symlink_to(script)
    for called in (script, link):
        done = subprocess.run([called, "ps", "a b"], capture_output=True, text=True, check=True)
        assert done.stdout == f"-S {called} ps a b\n"


def test_ctrl_c_while_packages_are_imported_waits_for_the_command(tmp_path: Path) -> None:
    """Python imports ``sitecustomize`` before any package, and is interrupted there."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\nos.kill(os.getpid(), signal.SIGINT)\nprint('interrupted')\n"
    )
    paths = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-S", SCRIPT, "ps"],
        env={**os.environ, "PYTHONPATH": paths, "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.stdout, done.stderr, done.returncode) == ("interrupted\n", "", 130)


def test_launching_spares_the_restart_that_the_ros_wheels_would_make(tmp_path: Path) -> None:
    """They start Python once more, with their libraries in ``LD_LIBRARY_PATH``."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os\nprint('started with', os.environ.get('LD_LIBRARY_PATH', 'no libraries'))\n"
    )
    guards = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
    own = {key: value for key, value in os.environ.items() if key not in guards}
    done = subprocess.run(
        [sys.executable, "-S", SCRIPT, "launch", "--help"],
        env={**own, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.startswith("started with no libraries\nusage: neuros launch ")


@pytest.mark.parametrize(
    ("line", "fitting"),
    [
        ("neuros la", {"launch"}),
        ("neuros rec", set()),  # the recorder is started by NeuROS itself
        ("neuros launch --backend in", {"in-process"}),
        ("neuros launch --viewer r", {"rerun", "rqt_graph", "rviz2"}),
        ("neuros stop --", {"--help", "--all"}),
        ("./launch.py --no-", {"--no-placement", "--no-portable", "--no-progress", "--no-ros"}),
    ],
)
def test_a_shell_that_completes_a_line_is_answered(
    line: str, fitting: set[str], tmp_path: Path
) -> None:
    answer = tmp_path / "answer"
    asked = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1"}
    asked |= {"_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    subprocess.run(
        [sys.executable, "-m", "neuros.cli"],
        env={**os.environ, **asked},
        cwd=ROOT,
        timeout=60,
        check=True,
    )
    assert {word.strip() for word in answer.read_text().split("\n")} - {""} == fitting


@pytest.mark.parametrize("program", [SCRIPT, ROOT / "launch.py"])
def test_argcomplete_finds_its_mark_in_both_programs(program: Path) -> None:
    assert b"PYTHON_ARGCOMPLETE_OK" in program.read_bytes()[:1024]


def test_completion_costs_nothing_where_no_shell_asks() -> None:
    program = (
        "import sys, neuros.cli.main as m; m.parser(); assert 'argcomplete' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, timeout=60, check=True)


def test_processes_of_multiprocessing_read_it_for_the_packages_alone(tmp_path: Path) -> None:
    """Those of Dask's workers, which Python starts as the script was started: without packages."""
    program = (
        f"import runpy; runpy.run_path({str(SCRIPT)!r}, run_name='__mp_main__')\nimport neuros"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-c", program], cwd=tmp_path, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, b""), done.stderr


def test_the_garbage_collector_passes_over_what_a_command_imports() -> None:
    program = """
import gc
from neuros.cli import main as program

def parser(command):
    assert not gc.isenabled()
    return parser_of(command)

parser_of, program.parser = program.parser, parser
assert program.main(["example"]) == 0
assert gc.isenabled() and gc.get_freeze_count() > 10_000
"""
    subprocess.run([sys.executable, "-c", program], stdout=subprocess.DEVNULL, check=True)


def test_a_python_without_neuros_says_what_to_run(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys._base_executable, "-I", SCRIPT, "ps"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.endswith(f"run {SCRIPT} by itself, without a Python before it\n")
    assert "Traceback" not in done.stderr
