"""A small project with all that replay has to reproduce, recorded, and ``neuros replay --node``."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from launching import launch

TYPE = "std_msgs/msg/Int32"

COUNTER = """\
import os

from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_tick


@neuros_initialise()
def begin(node):
    node.set_user_data({"sum": 0, "limit": int(open(os.environ["LIMIT"]).read())})


@neuros_tick(0.005, outputs=["number", Optional("own")])
def count(node):
    state = node.get_user_data()
    state["sum"] += 1
    number, own = node.make_packet("number"), node.make_packet("own")
    number.data = own.data = state["sum"]
    if state["sum"] >= state["limit"]:
        node.shutdown("counted")
    return number, own if state["sum"] % 2 else None


@neuros_function(inputs=Optional("back"), outputs=Optional("fast"))
def loop(node, back):
    state = node.get_user_data()
    if back is not None:
        state["sum"] += back.data % 3
    fast = node.make_packet("fast")
    fast.data = state["sum"]
    return fast


@neuros_function(inputs="again")
def keep(node, again):
    node.get_user_data()["sum"] += 2
"""

MIXER = """\
from neuros.hooks import All, Optional, neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data([0])


@neuros_function(inputs=["number", Optional("fast")], outputs="mixed")
def mix(node, number, fast):
    seen = node.get_user_data()
    seen[0] += number.data + (fast.data if fast is not None else 0)
    mixed = node.make_packet("mixed")
    mixed.data = seen[0] % 1000
    return mixed
"""


def node(name: str, plugin: str, inputs: Sequence[str], outputs: Sequence[str], **more: Any) -> Any:
    return {
        "name": name,
        "container": "neuros_python",
        "plugin": f"#{plugin}.py",
        "inputs": [{"name": each, "type": TYPE} for each in inputs],
        "outputs": [{"name": each, "type": TYPE} for each in outputs],
        **more,
    }


def wire(text: str, discard_limit: int | None = None) -> Any:
    ends = [end.split(".") for end in text.split(" -> ")]
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    limit = {} if discard_limit is None else {"discard_limit": discard_limit}
    return {**dict(zip(keys, [*ends[0], *ends[1]], strict=True)), **limit}


def write_project(folder: Path) -> Path:
    """Ticks, a free-running hook, a connection to itself, discards, best effort, and a loop."""
    folder.mkdir()
    (folder / "counter.py").write_text(COUNTER)
    (folder / "mixer.py").write_text(MIXER)
    counter = node("counter", "counter", ["back", "again"], ["number", "own", "fast"])
    (folder / "limit").write_text("60")
    counter["environment"] = {"LIMIT": "#limit"}
    project = {
        "nodes": [counter, node("mixer", "mixer", ["number", "fast"], ["mixed"])],
        "connections": [
            wire("counter.number -> mixer.number", 2),
            wire("counter.fast -> mixer.fast"),
            wire("counter.own -> counter.again", 0),
            wire("mixer.mixed -> counter.back", 0),
        ],
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


def replay(
    run: Path, name: str, *arguments: str, stdin: str = "", **environment: str
) -> subprocess.CompletedProcess[str]:
    """One node, in a process that the replayed plugin may do anything with."""
    return subprocess.run(
        [sys.executable, "-m", "neuros.cli", "replay", str(run), "--node", name, *arguments],
        input=stdin,
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        timeout=300,
        check=False,
    )


class Recorded(NamedTuple):
    project: Path
    run: Path


def record(folder: Path, backend: str) -> Recorded:
    project = write_project(folder / "project")
    finished = launch(project, "--backend", backend, "-r", cwd=folder, timeout_s=60.0)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    return Recorded(project, finished.run_folder)


def copied(recorded: Recorded, folder: Path) -> Recorded:
    """The same run, with a plugin and a bag that a test may change."""
    project, run = folder / "project", folder / "run"
    shutil.copytree(recorded.project, project)
    shutil.copytree(recorded.run, run, ignore=shutil.ignore_patterns("control.sock"))
    for file in (*run.glob("*/node.json"), run / "run.json"):
        file.write_text(file.read_text().replace(str(recorded.project), str(project)))
    return Recorded(project, run)


def assert_identical(recorded: Recorded, name: str, output: str) -> None:
    """That a replay said so, of every packet and every start of a hook in the run."""
    found = re.search(
        r"^identical: (\d+) packets on (\d) connections?; (\d+) starts of hooks\n\Z", output, re.M
    )
    assert found is not None, output
    record = json.loads((recorded.run / "run.json").read_text())
    sent = [c["sent"] for c in record["connections"] if c["connection"].startswith(f"{name}.")]
    executions = [hook["executions"] for hook in record["nodes"][name]["hooks"].values()]
    assert [int(each) for each in found.groups()] == [sum(sent), len(sent), sum(executions)]
