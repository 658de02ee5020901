"""Plugins of an installed package, in real runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, Finished, launch

from neuros.project.model import Connection

# Each node counts in a global of the module.
COUNTER = """
from neuros.hooks import *
from .limits import STROKES

strokes = 0

@neuros_initialise(outputs=Optional("out"))
def begin(node):
    return node.make_packet("out") if node.name == "ann" else None

@neuros_function(inputs="into", outputs=Optional("out"))
def answer(node, into):
    global strokes
    strokes += 1
    node.set_result("strokes", strokes)
    if node.name == "bob" and strokes >= STROKES:
        return node.shutdown("enough")
    return into
"""
FAILING = """
@neuros_initialise()
def listen(node):
    node.get_ros_node().create_timer(0.001, fail)

def fail():
    raise ValueError("not today")
"""
INT = "std_msgs/msg/Int32"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Two nodes of one module, in lockstep; it is in ``site-packages``, which Python searches."""
    package = tmp_path / "site-packages" / "lab"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "limits.py").write_text("STROKES = 6\n")
    (package / "counter.py").write_text(COUNTER)
    ports = {"inputs": [{"name": "into", "type": INT}], "outputs": [{"name": "out", "type": INT}]}
    node = {"container": "neuros_python", "plugin": "lab.counter", **ports}
    wires = (Connection("ann", "out", "bob", "into", 0), Connection("bob", "out", "ann", "into", 0))
    content = {
        "nodes": [{"name": name, **node} for name in ("ann", "bob")],
        "connections": [wire.keys for wire in wires],
    }
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "project.json").write_text(json.dumps(content))
    return folder


def run(project: Path, backend: str) -> Finished:
    installed = str(project.parent / "site-packages")
    return launch(project, "--backend", backend, cwd=project.parent, PYTHONPATH=installed)


@pytest.mark.parametrize("backend", BACKENDS)
def test_nodes_of_one_module_share_nothing_of_it(backend: str, project: Path) -> None:
    done = run(project, backend)
    assert done.exit_code == 0, done.output
    strokes = {name: node["results"]["strokes"] for name, node in done.record["nodes"].items()}
    assert strokes == {"ann": 5, "bob": 6}


def test_a_callback_that_fails_is_named_with_its_line(project: Path) -> None:
    plugin = project.parent / "site-packages" / "lab" / "counter.py"
    plugin.write_text(COUNTER.replace(">= STROKES", "< 0") + FAILING)
    done = run(project, "process")
    assert done.exit_code == 1, done.output
    line = plugin.read_text("utf-8").splitlines().index("def fail():") + 1
    assert f"{plugin}:{line}: callback 'fail': ValueError: not today" in done.output
