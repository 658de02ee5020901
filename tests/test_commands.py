"""Tests that can be started as commands find what they share with the others."""

import subprocess
import sys
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[1]
_COMMANDS = [
    ".".join(path.parent.relative_to(_ROOT).parts) for path in _ROOT.glob("tests/**/__main__.py")
]


@pytest.mark.parametrize("command", sorted(_COMMANDS))
def test_a_documented_command_of_the_tests_can_be_imported_as_python_m_imports_it(
    command: str,
) -> None:
    run = subprocess.run(
        [sys.executable, "-c", f"import {command}.__main__"],
        cwd=_ROOT,
        capture_output=True,
        text=True,
    )
    assert (run.returncode, run.stderr) == (0, "")
