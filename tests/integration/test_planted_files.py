"""A node may write to the run folder: it can neither lead the launcher elsewhere nor hold it up."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

from launching import Finished, launch

PLANTER = """
import os
from neuros.hooks import neuros_initialise, neuros_tick

@neuros_initialise()
def plant(node):
    run = node.run_dir.parent
    for name in (".run.json", "run.json", "planter/versions.json", "planter/results.json"):
        (run / name).unlink(missing_ok=True)
        {plant}

@neuros_tick(seconds=0.01, outputs=[])
def end(node):
    node.shutdown("planted")
"""


def run_of(folder: Path, plant: str) -> Finished:
    """A run whose node does ``plant`` with ``run / name``, for several names."""
    project = folder / "project"
    project.mkdir()
    (project / "planter.py").write_text(PLANTER.format(plant=plant))
    node = {"name": "planter", "container": "neuros_python", "plugin": "planter.py"}
    (project / "project.json").write_text(json.dumps({"nodes": [node], "connections": []}))
    return launch(project, "--backend", "process", "-o", "out", "-m", cwd=folder, timeout_s=30.0)


def test_the_launcher_does_not_follow_a_link_of_a_node(tmp_path: Path) -> None:
    victim = tmp_path / "elsewhere.txt"
    victim.write_text("mine")
    run = run_of(tmp_path, f"os.symlink({str(victim)!r}, run / name)")
    assert victim.read_text() == "mine"
    assert run.exit_code == 0
    assert run.record["reason"] == "planter ended the project: planted"
    assert not (tmp_path / "out/run.json").is_symlink()
    assert not (tmp_path / "out/.run.json").exists()


def test_the_launcher_does_not_wait_for_a_pipe_of_a_node(tmp_path: Path) -> None:
    run = run_of(tmp_path, "os.mkfifo(run / name)")
    assert run.exit_code == 0
    assert run.record["reason"] == "planter ended the project: planted"


def test_a_folder_in_the_place_of_the_record_is_named(tmp_path: Path) -> None:
    run = run_of(tmp_path, "os.makedirs(run / '.run.json', exist_ok=True)")
    assert run.exit_code == 4
    found = re.search(r"run\.json cannot be written \(Is a directory\): it is in (\S+)", run.output)
    assert found
    shutil.rmtree(found[1])
