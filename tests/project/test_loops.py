"""Who starts the loops of a project, as far as plugins tell without being run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from neuros.project.load import load_project
from neuros.project.loops import Loops

INT = "std_msgs/msg/Int32"
PASS_ON = "@neuros_function(inputs='in', outputs='out')\ndef step(node, x): return x\n"
SOMETIMES = "@neuros_function(inputs=Optional('in'), outputs='out')\ndef step(node, x): return x\n"
BEGIN = "@neuros_initialise(outputs='out')\ndef begin(node): return node.make_packet('out')\n"
TICK = "@neuros_tick(0.1, outputs='out')\ndef tick(node): return node.make_packet('out')\n"
LATE = "@neuros_initialise(inputs='in', outputs='out')\ndef begin(node, x): return x\n"


def ring(folder: Path, *plugins: str) -> Loops:
    """Nodes ``n0``, ``n1``, ...; the output of each leads to the input of the next one."""
    nodes, connections = [], []
    for place, text in enumerate(plugins):
        name = f"n{place}"
        (folder / f"{name}.py").write_text(f"from neuros.hooks import *\n{text}")
        nodes.append(
            {
                "name": name,
                "container": "neuros_python",
                "plugin": f"{name}.py",
                "inputs": [{"name": "in", "type": INT}],
                "outputs": [{"name": "out", "type": INT}],
            }
        )
        connections.append(
            {
                "source_node": name,
                "source_output": "out",
                "destination_node": f"n{(place + 1) % len(plugins)}",
                "destination_input": "in",
                "discard_limit": 0,
            }
        )
    content = {"nodes": nodes, "connections": connections}
    (folder / "project.json").write_text(json.dumps(content))
    return Loops(load_project(folder, workspace=folder, reads_plugins=True).project)


@pytest.mark.parametrize(
    ("plugin", "starter"),
    [
        (PASS_ON + BEGIN, "initialise hook 'begin' of n1"),
        (TICK + "@neuros_function('in')\ndef take(node, x): ...", "tick 'tick' of n1"),
        (SOMETIMES, "hook 'step' of n1"),
    ],
    ids=["initialise", "tick", "main loop"],
)
def test_a_loop_tells_who_starts_it(tmp_path: Path, plugin: str, starter: str) -> None:
    loops = ring(tmp_path, PASS_ON, plugin, PASS_ON)
    (loop,) = loops.found
    assert str(loop) == f"loop of n0, n1, n2: started by {starter}"
    assert not [*loops.problems()]


def test_ways_that_join_again_are_no_loop(tmp_path: Path) -> None:
    ring(tmp_path, PASS_ON, PASS_ON, PASS_ON)
    project = json.loads((tmp_path / "project.json").read_text())
    project["connections"][2] |= {"source_node": "n0", "destination_node": "n2"}
    (tmp_path / "project.json").write_text(json.dumps(project))
    loops = Loops(load_project(tmp_path, workspace=tmp_path).project)
    assert loops.found == ()
    assert not [*loops.problems()]


@pytest.mark.parametrize("length", [1, 2, 3])
@pytest.mark.parametrize("waiting", [PASS_ON, LATE], ids=["function", "initialise"])
def test_a_loop_that_nobody_starts_is_a_problem_with_its_place_and_cure(
    tmp_path: Path, waiting: str, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    loops = ring(tmp_path, *[waiting] * length)
    (problem,) = loops.problems()
    assert str(problem).startswith("n0.py:2:")
    assert "nobody starts the loop of n0" in problem.text
    assert '@neuros_initialise(outputs=["out"]) in n0.py' in problem.hint
    assert [loop.started_by for loop in loops.found] == [()]


@pytest.mark.parametrize(
    "plugin",
    [
        "NAME = 'o' + 'ut'\n@neuros_tick(1, outputs=NAME)\ndef f(node): ...\n" + PASS_ON,
        PASS_ON + "def begin(node): node.submit({})\n",
        "if True:\n    @neuros_initialise(outputs='out')\n    def f(node): ...\n" + PASS_ON,
        PASS_ON + "again = neuros_tick(1, outputs='out')(step)\n",
        "from beside import begin\n" + PASS_ON,
        "from beside import *\n" + PASS_ON,
    ],
    ids=["computed name", "thread", "condition", "call", "imported", "star"],
)
def test_where_packets_may_come_from_is_not_guessed(tmp_path: Path, plugin: str) -> None:
    (tmp_path / "beside.py").write_text(f"from neuros.hooks import *\n{BEGIN}")
    loops = ring(tmp_path, PASS_ON, plugin)
    assert not [*loops.problems()]
    assert [loop.started_by for loop in loops.found] == [None]


def test_functions_of_a_module_beside_the_plugin_start_nothing(tmp_path: Path) -> None:
    (tmp_path / "beside.py").write_text("def help(x): return x\n")
    loops = ring(tmp_path, PASS_ON, "from beside import help\n" + PASS_ON)
    assert len([*loops.problems()]) == 1


def test_a_long_row_of_nodes_is_followed_to_its_end(tmp_path: Path) -> None:
    loops = ring(tmp_path, *[PASS_ON] * 60, PASS_ON + BEGIN)
    assert not [*loops.problems()]


@pytest.mark.parametrize(("starter", "is_said"), [(PASS_ON + BEGIN, True), (SOMETIMES, False)])
def test_where_a_lost_packet_ends_a_loop_that_starts_once_is_said(
    tmp_path: Path, starter: str, is_said: bool
) -> None:
    ring(tmp_path, PASS_ON, starter)
    project = json.loads((tmp_path / "project.json").read_text())
    del project["connections"][1]["discard_limit"]
    (tmp_path / "project.json").write_text(json.dumps(project))
    (loop,) = Loops(load_project(tmp_path, workspace=tmp_path).project).found
    said = 'stops for good if a packet is lost on n1.out -> n0.in (add "discard_limit": 0)'
    assert (said in str(loop)) is is_said
