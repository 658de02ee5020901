"""A project, and a recorded run of it, as a version of NeuROS made them."""

from __future__ import annotations

import json
import platform
import shutil
from pathlib import Path

from neuros.distribution import __version__
from tests.support.launching import REPOSITORY, launch

HERE = Path(__file__).resolve().parent
KEPT = HERE / "kept"
HOME = "/home/user/experiment"
"""Stands in kept files for the folder that they lie in."""

PATIENCE_S = 120.0
_TEXTS = (".json", ".yaml", ".log", ".txt", ".csv")


def make(folder: Path = KEPT / __version__) -> Path:
    """Keep the project and a run of it, of this version, in ``folder``, whose content goes."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(HERE / "project", folder / "project", ignore=_COMPILED)
    options = ("--backend", "process", "-r", "-o", "run")
    finished = launch(folder / "project", *options, cwd=folder, timeout_s=PATIENCE_S)
    assert finished.exit_code == 0, finished.output
    shutil.rmtree(folder / "project/__pycache__", ignore_errors=True)
    _replace(folder, str(folder), HOME)
    _replace(folder, str(REPOSITORY), "/home/user/neuros")
    _replace(folder, platform.release(), "6.1.0-13-amd64")
    _replace(folder, json.dumps(platform.node()), '"desk"')
    return folder


def unpacked(kept: Path, folder: Path) -> Path:
    """A copy of what was kept, in ``folder``, as if it had always been there."""
    shutil.copytree(kept, folder, ignore=_COMPILED)
    _replace(folder, HOME, str(folder))
    return folder


def _replace(folder: Path, old: str, new: str) -> None:
    for file in folder.rglob("*"):
        if file.suffix in _TEXTS and file.is_file():
            file.write_text(file.read_text("utf-8").replace(old, new), "utf-8")


_COMPILED = shutil.ignore_patterns("__pycache__")
