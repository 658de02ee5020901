"""What becomes of a test for which this machine lacks something."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import needs
import pytest

PROJECT = """
import pytest
from needs import require

@pytest.fixture(params=[1, 2])
def laboratory():
    require("git")

@pytest.mark.needs("git", "iptables")
def test_one():
    assert False, "it does not begin"

def test_two(laboratory):
    assert False, "it does not begin"

def test_three():
    pass
"""


@pytest.fixture
def tests(tmp_path: Path) -> Path:
    """A folder with tests that need what is not there, under this project's ``conftest.py``."""
    here = Path(__file__).parent
    for file in (here.parent / "conftest.py", here / "support/marking.py", here / "needs.py"):
        shutil.copy(file, tmp_path)
    (tmp_path / "needs.py").write_text(
        Path(needs.__file__).read_text().replace("__file__", repr(needs.__file__))
        + "\nfor _name in NEEDS:\n"
        "    NEEDS[_name] = NEEDS[_name]._replace(is_there=lambda: False)\n"
        "os.geteuid = lambda: int(os.environ['USER_ID'])\n"
        "shutil.which = lambda name: name if name in os.environ['PROGRAMS'] else None\n"
    )
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  needs\n  unit\npythonpath = .\n")
    (tmp_path / "test_it.py").write_text(PROJECT)
    return tmp_path


def run(tests: Path, *, user: int = 1000, **environment: str) -> tuple[int, list[str]]:
    """The exit code of pytest, and what it prints."""
    clean = {key: value for key, value in os.environ.items() if key != "CI"}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", str(tests)],
        env={
            **clean,
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
            "USER_ID": str(user),
            "PROGRAMS": "apt-get",
            **environment,
        },
        cwd=tests,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout.splitlines()


def test_an_ordinary_users_tests_are_left_out_and_counted_apart(tests: Path) -> None:
    code, lines = run(tests)
    assert code == 0
    begin = next(at for at, line in enumerate(lines) if "left out, for want of" in line)
    assert lines[begin + 1 : begin + 4] == [
        "2 tests need git",
        "1 test needs git, iptables",
        "sudo apt-get install -y git iptables",
    ]
    assert lines[-1].startswith("1 passed, 3 skipped")


@pytest.mark.parametrize(("user", "environment"), [(0, {}), (1000, {"CI": "1"})])
def test_where_it_could_be_had_they_fail_in_one_line(
    tests: Path, user: int, environment: dict[str, str]
) -> None:
    code, lines = run(tests, user=user, **environment)
    assert code == 1
    assert "needs git, iptables: apt-get install -y git iptables" in lines
    assert lines[-1].startswith("1 passed, 3 errors")
    assert not any("it does not begin" in line or "left out" in line for line in lines)


def test_root_of_a_system_without_apt_has_them_left_out(tests: Path) -> None:
    code, lines = run(tests, user=0, PROGRAMS="")
    assert code == 0
    assert lines[-1].startswith("1 passed, 3 skipped")


def test_the_program_runs_on_a_bare_python() -> None:
    python = getattr(sys, "_base_executable", sys.executable)
    done = subprocess.run(
        [python, "-I", needs.__file__], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
