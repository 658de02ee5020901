"""``neuros replay RUN --node NAME`` on real runs: record, replay each node, change something."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from launching import EXAMPLES, launch

TYPE = "std_msgs/msg/Int32"

COUNTER = """\
import os

from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_tick


@neuros_initialise()
def begin(node):
    node.set_user_data({"sum": 0, "limit": int(os.environ["LIMIT"])})


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
    counter["environment"] = {"LIMIT": "60"}
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
    run: Path, name: str, *arguments: str, stdin: str = ""
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "neuros.cli", "replay", str(run), "--node", name, *arguments],
        input=stdin,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


class Recorded(NamedTuple):
    project: Path
    run: Path


def record(folder: Path, backend: str) -> Recorded:
    project = write_project(folder / "project")
    finished = launch(project, "--backend", backend, "-r", cwd=folder)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    return Recorded(project, finished.run_folder)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("recorded"), "process")


@pytest.fixture(scope="module")
def recorded_in_process(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("recorded"), "in-process")


@pytest.fixture
def own(recorded: Recorded, tmp_path: Path) -> Recorded:
    """The same run, with a plugin and a bag that a test may change."""
    project, run = tmp_path / "project", tmp_path / "run"
    shutil.copytree(recorded.project, project)
    shutil.copytree(recorded.run, run, ignore=shutil.ignore_patterns("control.sock"))
    for file in run.glob("*/node.json"):
        file.write_text(file.read_text().replace(str(recorded.project), str(project)))
    return Recorded(project, run)


@pytest.mark.parametrize("name", ["counter", "mixer"])
@pytest.mark.parametrize("back_end", ["recorded", "recorded_in_process"])
def test_every_node_does_and_sends_the_same_again(
    request: pytest.FixtureRequest, back_end: str, name: str
) -> None:
    recorded: Recorded = request.getfixturevalue(back_end)
    done = replay(recorded.run, name)
    assert done.returncode == 0, done.stdout + done.stderr
    found = re.fullmatch(
        r"identical: (\d+) packets on (\d) connections?; (\d+) starts of hooks\n", done.stdout
    )
    assert found is not None
    record = json.loads((recorded.run / "run.json").read_text())
    sent = [c["sent"] for c in record["connections"] if c["connection"].startswith(f"{name}.")]
    executions = [hook["executions"] for hook in record["nodes"][name]["hooks"].values()]
    assert [int(each) for each in found.groups()] == [sum(sent), len(sent), sum(executions)]


def test_a_changed_plugin_is_told_by_packet_and_field(own: Recorded) -> None:
    plugin = own.project / "mixer.py"
    plugin.write_text(MIXER.replace("seen[0] % 1000", "seen[0] % 1000 + (seen[0] > 20)"))
    done = replay(own.run, "mixer")
    assert done.returncode == 1, done.stdout + done.stderr
    assert f"note: {plugin} was changed after the run had begun" in done.stdout
    found = re.search(
        r"different: mixer.mixed -> counter.back: packet (\d+) differs in data:"
        r" (\d+) in the run, (\d+) in the replay\n",
        done.stdout,
    )
    assert found is not None
    number, before, after = map(int, found.groups())
    assert after == before + 1
    assert number > 1


def test_a_plugin_that_fails_now_is_different(own: Recorded) -> None:
    (own.project / "mixer.py").write_text(MIXER.replace("seen[0] += ", "seen[1] += "))
    done = replay(own.run, "mixer")
    assert done.returncode == 1
    assert "different: it failed, and did not in the run: " in done.stdout
    assert "IndexError: list index out of range" in done.stdout


def test_under_pdb_it_stops_in_hooks_and_after_a_failure(own: Recorded) -> None:
    plugin = own.project / "mixer.py"
    plugin.write_text(MIXER.replace("seen[0] += ", "seen[1] += "))
    done = replay(
        own.run,
        "mixer",
        "--pdb",
        stdin="p 'fir' + 'st'\nc\np 'sec' + 'ond', number.data\nc\np 'aft' + 'er', seen\nq\n",
    )
    assert done.returncode == 1, done.stdout + done.stderr
    first, second, after = (
        done.stdout.index(text) for text in ("'first'", "('second', ", "('after', [0])")
    )
    assert first < second < after


def test_breakpoint_in_a_plugin_has_the_terminal(own: Recorded) -> None:
    (own.project / "mixer.py").write_text(
        MIXER.replace("    mixed = ", "    if seen[0] > 20:\n        breakpoint()\n    mixed = ", 1)
    )
    mine, theirs = pty.openpty()
    try:
        with subprocess.Popen(
            [sys.executable, "-m", "neuros.cli", "replay", str(own.run), "--node", "mixer"],
            stdin=theirs,
            stdout=theirs,
            stderr=subprocess.DEVNULL,
        ) as process:
            os.write(mine, b"p 40 + 2\nq\n")
            assert process.wait(60) == 130
        text = os.read(mine, 65536).decode()
    finally:
        os.close(mine)
        os.close(theirs)
    assert "\r\n42\r\n" in text
    assert "left after" in text
    assert "identical so far" in text


def test_the_run_folder_stays_as_it_is(recorded: Recorded, tmp_path: Path) -> None:
    before = sorted(recorded.run.rglob("*"))
    done = replay(recorded.run, "mixer", "-o", str(tmp_path / "kept"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(recorded.run.rglob("*")) == before
    assert (tmp_path / "kept/mixer/node.json").is_file()


def test_a_node_that_the_run_has_not(recorded: Recorded) -> None:
    done = replay(recorded.run, "nobody")
    assert done.returncode == 2
    assert f"{recorded.run} has no node 'nobody'; it has counter, mixer" in done.stderr


def test_a_plugin_that_is_gone(own: Recorded) -> None:
    (own.project / "mixer.py").unlink()
    done = replay(own.run, "mixer")
    assert done.returncode == 2
    assert f"the plugin of 'mixer' is gone: {own.project / 'mixer.py'}" in done.stderr


def test_a_journal_that_was_cut_off_is_replayed_as_far_as_it_goes(own: Recorded) -> None:
    journal = own.run / "mixer/packets/journal"
    journal.write_bytes(journal.read_bytes()[: journal.stat().st_size // 2])
    done = replay(own.run, "mixer")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "what it sent later is not compared" in done.stdout


def test_a_truncated_bag_is_replayed_as_far_as_it_goes(own: Recorded) -> None:
    (bag,) = (own.run / "bag").glob("*.mcap")
    bag.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    done = replay(own.run, "mixer")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the others are not compared" in done.stdout
    assert "the replay ends there" in done.stdout
    assert re.search(r"identical: [1-9]\d* packets", done.stdout)


def test_a_run_that_was_not_recorded(tmp_path: Path) -> None:
    finished = launch(EXAMPLES / "2_synchronisation/tennis", "--backend", "process", cwd=tmp_path)
    assert finished.run_folder is not None
    done = replay(finished.run_folder, "ann")
    assert done.returncode == 2
    assert "was not recorded" in done.stderr


def test_a_connection_that_was_left_out(tmp_path: Path) -> None:
    finished = launch(
        EXAMPLES / "2_synchronisation/tennis",
        *("--backend", "process", "-r", "--exclude", "bob.*"),
        cwd=tmp_path,
    )
    assert finished.run_folder is not None
    done = replay(finished.run_folder, "ann")
    assert done.returncode == 2
    assert "what 'ann' received on bob.ball_out -> ann.ball_in was not recorded" in done.stderr
    done = replay(finished.run_folder, "bob")
    assert done.returncode == 2
    assert "unknown: what it sends was not recorded" in done.stdout
