"""What a running node really has: the cores of all its threads, those of DDS too, and its limits.

Real launchers and nodes on real rclpy.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from launching import BACKENDS, launch

from neuros.backends.node_command import THREAD_VARIABLES

CORES = sorted(os.sched_getaffinity(0))
PORT = "std_msgs/msg/Int32"
HEAD = """
import contextlib, json, os
from neuros.hooks import neuros_function, neuros_initialise
def write(node):
    masks = []
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            masks.append(sorted(os.sched_getaffinity(int(thread))))
    limits = {key: value for key, value in os.environ.items() if key.endswith("_NUM_THREADS")}
    (node.run_dir / "found.json").write_text(json.dumps({"masks": masks, "limits": limits}))
"""
SENDER = """
@neuros_initialise(outputs="o")
def send(node):
    write(node)
    return node.make_packet("o")
"""
RECEIVER = """
@neuros_function(inputs="x")
def take(node, x):
    write(node)
    node.shutdown("enough")
"""

several_cores = pytest.mark.skipif(len(CORES) < 2, reason="one core only")


@pytest.fixture(autouse=True)
def _no_limits_of_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.endswith("_NUM_THREADS")]:
        monkeypatch.delenv(name)


def project(folder: Path, a: Mapping[str, Any], b: Mapping[str, Any]) -> Path:
    """``a`` sends one packet to ``b``."""
    (folder / "a.py").write_text(HEAD + SENDER)
    (folder / "b.py").write_text(HEAD + RECEIVER)
    common = {"container": "neuros_python"}
    nodes = [
        {"name": "a", "plugin": "a.py", "outputs": [{"name": "o", "type": PORT}], **common, **a},
        {"name": "b", "plugin": "b.py", "inputs": [{"name": "x", "type": PORT}], **common, **b},
    ]
    ends = ("source_node", "source_output", "destination_node", "destination_input")
    connection = {**dict(zip(ends, "aobx", strict=True)), "discard_limit": 0}
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": [connection]}))
    return file


def found(
    folder: Path,
    *options: str,
    a: Mapping[str, Any] | None = None,
    b: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What both nodes found."""
    run = launch(project(folder, a or {}, b or {}), *options, cwd=folder)
    assert run.exit_code == 0, run.output
    assert run.run_folder is not None
    first, second = (json.loads((run.run_folder / n / "found.json").read_text()) for n in "ab")
    return first, second


def every(thread_masks: list[list[int]]) -> list[int]:
    """The one mask that all threads have."""
    assert len({tuple(mask) for mask in thread_masks}) == 1
    return thread_masks[0]


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_affinity_every_core_is_there_and_thread_pools_have_one_thread(
    tmp_path: Path, backend: str
) -> None:
    a, b = found(tmp_path, "--backend", backend)
    assert every(a["masks"]) == every(b["masks"]) == CORES
    assert a["limits"] == dict.fromkeys(THREAD_VARIABLES, "1")


@several_cores
def test_affinity_is_kept_and_the_environment_of_a_node_wins_over_its_limits(
    tmp_path: Path,
) -> None:
    two, last = CORES[:2], CORES[-1:]
    a, b = found(
        tmp_path, a={"affinity": two}, b={"affinity": last, "environment": {"MKL_NUM_THREADS": 7}}
    )
    assert len(a["masks"]) > 3, "the threads of DDS are among them"
    assert every(a["masks"]) == two
    assert every(b["masks"]) == last
    assert a["limits"]["OMP_NUM_THREADS"] == a["limits"]["NUMBA_NUM_THREADS"] == "2"
    assert b["limits"]["OMP_NUM_THREADS"] == "1"
    assert b["limits"]["MKL_NUM_THREADS"] == "7"


@several_cores
@pytest.mark.parametrize("backend", BACKENDS)
def test_without_placement_every_core_is_there_also_for_a_node_with_affinity(
    tmp_path: Path, backend: str
) -> None:
    options = ("--no-placement", "--backend", backend)
    a, b = found(tmp_path, *options, a={"affinity": [CORES[0]]})
    assert every(a["masks"]) == every(b["masks"]) == CORES


@several_cores
def test_in_process_all_nodes_share_the_cores_that_some_ask_for(tmp_path: Path) -> None:
    a, b = found(tmp_path, "--backend", "in-process", a={"affinity": [CORES[-1]]})
    assert every(a["masks"]) == every(b["masks"]) == [CORES[-1]]
    assert a["limits"]["OMP_NUM_THREADS"] == "1"


def test_a_core_that_this_machine_lacks_is_no_mistake_in_the_project(tmp_path: Path) -> None:
    file = project(tmp_path, {"affinity": [999]}, {})
    run = launch(file, cwd=tmp_path)
    assert run.exit_code == 4
    assert "/nodes/0/affinity: node 'a' asks for core 999\n" in run.output
    assert f"NeuROS may use core{'s' if len(CORES) > 1 else ''} {CORES[0]}" in run.output
    assert run.run_folder is None, "nothing was started"
    assert launch(file, "--no-placement", cwd=tmp_path).exit_code == 0
