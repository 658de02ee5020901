"""What pip, venv and the file system say becomes one sentence."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from neuros.launch.environments.reasons import why_no_files, why_no_venv, why_pip_failed

CONFLICT = """\
ERROR: Cannot install jsonschema<4 and jsonschema<5 because these have conflicting dependencies.

The conflict is caused by:
    The user requested jsonschema<5
    The user requested jsonschema<4

To fix this you could try to:
"""
NONE = "ERROR: Could not find a version that satisfies the requirement {} (from versions: {})\n"


@pytest.mark.parametrize(
    ("output", "sentence"),
    [
        (
            NONE.format("a==9", "1, 2, 3, 4, 5, 6, 7"),
            "no a==9 exists for Python 3.12 (there is ..., 3, 4, 5, 6, 7)",
        ),
        (
            NONE.format("a==9", "1"),
            "no a==9 exists for Python 3.12 (there is 1)",
        ),
        (
            NONE.format("a", "none"),
            "no a exists for Python 3.12 (pip finds none of that name)",
        ),
        (
            CONFLICT,
            "these exclude each other: The user requested jsonschema<5; The user requested"
            " jsonschema<4; NeuROS needs jsonschema<5,>=4",
        ),
        ("Looking\nERROR: Invalid requirement: 'a b'\nmore\n", "Invalid requirement: 'a b'"),
        ("", "pip failed"),
    ],
)
def test_what_pip_says(output: str, sentence: str) -> None:
    assert why_pip_failed(output, "3.12", ["jsonschema<5,>=4", "tabulate"]) == sentence


def test_without_a_network_no_package_is_blamed() -> None:
    output = "NewConnectionError\n" + NONE.format("a", "none")
    sentence = why_pip_failed(output, "3.12", [])
    assert "cannot be reached" in sentence
    assert sentence.endswith("then launch again")


def test_a_python_without_venv_is_told_what_to_install() -> None:
    assert "python3.12-venv" in why_no_venv("No module named venv", "3.12")
    assert why_no_venv("first\nlast", "3.12") == "last"


def test_a_folder_that_cannot_be_written_is_named() -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/c/x")
    assert why_no_files(full, Path("/c")).startswith("the disk of /c is full: make room")
    refused = OSError(errno.EROFS, os.strerror(errno.EROFS), "/c/x")
    assert why_no_files(refused, Path("/c")).startswith("/c/x: Read-only file system: set XDG")
