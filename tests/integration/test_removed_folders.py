"""A run whose folder is removed while it goes on is a failure that is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, launch

PLUGIN = """
import os, shutil
from neuros.hooks import neuros_tick

@neuros_tick(seconds=0.01)
def tick(node):
    folder = node.run_dir if os.environ["WHAT"] == "own" else node.run_dir.parent
    if os.environ["WHAT"] == "moved":
        folder.rename(folder.with_name("elsewhere"))
    else:
        shutil.rmtree(folder)
    node.shutdown("all is gone")
"""


@pytest.mark.parametrize("back_end", BACKENDS)
@pytest.mark.parametrize(("what", "gone"), [("all", "run"), ("moved", "run"), ("own", "run/a")])
def test_a_folder_that_was_removed_is_exit_code_4_and_named(
    tmp_path: Path, back_end: str, what: str, gone: str
) -> None:
    (tmp_path / "plugin.py").write_text(PLUGIN)
    nodes = [
        {
            "name": name,
            "container": "neuros_python",
            "plugin": plugin,
            "environment": {"WHAT": what},
        }
        for name, plugin in (("a", "plugin.py"), ("b", "idle.py"))
    ]
    (tmp_path / "idle.py").write_text(
        "from neuros.hooks import neuros_initialise\n\n@neuros_initialise()\ndef f(node): pass\n"
    )
    (tmp_path / "project.json").write_text(json.dumps({"nodes": nodes, "connections": []}))
    finished = launch(tmp_path, "--backend", back_end, "-o", str(tmp_path / "run"), cwd=tmp_path)
    assert finished.exit_code == 4, finished.output
    told = f"{tmp_path / gone} was removed while the run went on: what was written there before"
    assert told in finished.output.splitlines()[-1]
