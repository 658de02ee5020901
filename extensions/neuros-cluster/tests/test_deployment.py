"""A project with an agent for some of its nodes, on this very machine: no ``ssh``, no root."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from back_end_checks import PROJECTS
from deadlines import wait_until
from ending_bench import Bench, assert_ended
from launching import Finished, Running, killed_in_a_hook, launch, start
from neuros_cluster.deployment_file import Host
from neuros_cluster.machine import Machine, agent_command
from neuros_cluster.messages import Lacking, Start, ThreadsRead

import neuros
from neuros.backends.control_sockets import connect
from neuros.control.link import encode
from neuros.errors import EnvironmentFault
from neuros.stacks import ProcessThreads

STREAM = Path(__file__).parents[3] / "tests/integration/network/stream"
NEUROS = Path(sys.executable).with_name("neuros")
CONNECTION = "source.image -> sink.image"
SLOW_NETWORK = """
import os, subprocess, sys, time
held, goes_on, *command = sys.argv[1:]
agent = subprocess.Popen(command, stdout=subprocess.PIPE)
for length in iter(lambda: agent.stdout.read(4), b""):
    message = length + agent.stdout.read(int.from_bytes(length, "little"))
    if b"kind\\xa5hooks" in message:
        open(held, "w").close()
        while not os.path.exists(goes_on):
            time.sleep(0.01)
    os.write(1, message)
sys.exit(agent.wait())
"""
BEGINS = """
from pathlib import Path
from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise
@neuros_initialise(outputs="o")
def begin(node):
    Path("{begun}").touch()
    return node.make_packet("o")
@neuros_function(inputs="x")
def take(node, x):
    Path("{begun}").touch()
@neuros_finalise()
def end(node):
    Path("{begun}").touch()
"""
SENDS = """
from pathlib import Path
from neuros.hooks import neuros_function, neuros_tick
@neuros_tick(seconds=0.05, outputs="o")
def look(node):
    Path("{begun}").touch()
    return node.make_packet("o")
@neuros_function(inputs="x")
def take(node, x):
    pass
"""
ENDED_S = 120.0  # on a machine that does many other things


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return Path(shutil.copytree(STREAM, tmp_path / "stream"))


def deployment(folder: Path, *, through: Sequence[str] = (), **more: Any) -> Path:
    """The sink is with an agent, which has a cache and a current folder of its own."""
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir(exist_ok=True)
    apart = ["env", f"--chdir={elsewhere}", f"XDG_CACHE_HOME={elsewhere}"]
    host = {"through": [*through, *apart], "neuros": str(NEUROS), "address": "127.0.0.1"}
    content = {"hosts": {"other": host}, "nodes": {"sink": "other"}, "timeout_s": 60, **more}
    file = folder / "deployment.json"
    file.write_text(json.dumps(content))
    return file


def deployed(project: Path, *arguments: str, cwd: Path) -> Running:
    file = deployment(cwd)
    return start(project, "--deployment", str(file), *arguments, cwd=cwd)


def left_there(folder: Path) -> list[str]:
    """What agents have left in their cache, beside the trees and environments that are kept."""
    return [path.name for path in (folder / "elsewhere/neuros/machines").glob("r*-*")]


def trees_there(folder: Path) -> list[Path]:
    return sorted((folder / "elsewhere/neuros/machines").glob("stream-*"))


def assert_all_arrived(finished: Finished, count: int = 100) -> None:
    assert finished.exit_code == 0, finished.output
    books = finished.connection(CONNECTION)
    assert (books["sent"], books["received"], books["lost"]) == (count, count, 0)
    assert finished.run_folder is not None
    received = json.loads((finished.run_folder / "sink" / "received.json").read_text())
    assert received["numbers"] == list(range(1, count + 1))


def test_one_command_starts_nodes_elsewhere_and_brings_home_all_they_leave(
    project: Path, tmp_path: Path
) -> None:
    with deployed(project, "--record", cwd=tmp_path) as running:
        finished = running.finish(ENDED_S)
    assert_all_arrived(finished)
    assert "the first image is here" in finished.output
    assert f"recorded 100 packets on 1 topic: {finished.run_folder}/bag" in finished.output
    machine = finished.record["machines"]["other"]
    assert (machine["nodes"], machine["lost"]) == (["sink"], "")
    assert finished.connection(CONNECTION)["latency_ms"]["p50"] > 0
    assert left_there(tmp_path) == []
    assert len(trees_there(tmp_path)) == 1


def test_a_node_elsewhere_goes_on_learning(project: Path, tmp_path: Path) -> None:
    sink = project / "sink.py"
    keeps = "    node.keep('seen', lambda: len(numbers), lambda n: numbers.extend([0] * n))\n"
    begins = f"\n@neuros_initialise()\ndef begin(node):\n{keeps}"
    imports = "from neuros.hooks import neuros_finalise, neuros_function"
    sink.write_text(sink.read_text().replace(imports, f"{imports}, neuros_initialise") + begins)
    runs: list[Finished] = []
    for more in ([], ["--restore", f"sink.seen={tmp_path / 'first'}"]):
        folder = ["-o", "second" if runs else "first"]
        with deployed(project, *folder, *more, cwd=tmp_path) as running:
            runs.append(running.finish(ENDED_S))
        assert runs[-1].exit_code == 0, runs[-1].output
    first, second = (finished.record["nodes"]["sink"] for finished in runs)
    assert second["restored"]["seen"]["sha256"] == first["kept"]["seen"]["sha256"]
    assert neuros.Run(tmp_path / "second").kept("sink.seen") == 200


def test_it_is_said_where_a_node_elsewhere_stood_that_is_killed(tmp_path: Path) -> None:
    file = str(deployment(tmp_path, nodes={"reader": "other"}))
    with start(PROJECTS / "stuck", "--deployment", file, cwd=tmp_path) as running:
        finished = killed_in_a_hook(running, ENDED_S)
    assert "in compute" in finished.record["nodes"]["reader"]["stack"], finished.output
    assert f'File "{PROJECTS}/stuck/reader.py"' in finished.output
    assert left_there(tmp_path) == []


def test_no_node_takes_part_before_its_launcher_knows_that_a_node_elsewhere_could(
    tmp_path: Path,
) -> None:
    """So that all begin together, however slow the network is."""
    held, goes_on = tmp_path / "held", tmp_path / "goes_on"
    begun = {name: tmp_path / f"{name}_has_begun" for name in ("eye", "brain")}
    bench = Bench(tmp_path, "process")
    bench.project(
        ("eye.o -> brain.x", 0),
        ("brain.o -> eye.x", 0),
        eye=BEGINS.format(begun=begun["eye"]),
        brain=SENDS.format(begun=begun["brain"]),
    )
    (tmp_path / "slow_network.py").write_text(SLOW_NETWORK)
    late = [sys.executable, str(tmp_path / "slow_network.py"), str(held), str(goes_on)]
    file = deployment(tmp_path, nodes={"eye": "other"}, through=late)
    with bench.start("--deployment", str(file), "--duration", "1") as running:
        running.wait_for("eye has not reported for 5 s", ENDED_S)
        assert held.exists()
        assert not any(path.exists() for path in begun.values())
        goes_on.touch()
        finished = running.finish(ENDED_S)
    assert_ended(finished, 0, "1 s are over")
    assert all(path.exists() for path in begun.values())


def test_a_dry_run_says_what_would_run_where_and_reaches_nobody(
    project: Path, tmp_path: Path
) -> None:
    file = str(deployment(tmp_path))
    finished = launch(project, "--deployment", file, "--dry-run", cwd=tmp_path, timeout_s=ENDED_S)
    assert finished.exit_code == 0, finished.output
    assert "process source: " in finished.output
    assert "process sink on other\n" in finished.output
    assert not list((tmp_path / "elsewhere").iterdir())


ANSWERS = """
import os, sys
while data := os.read(0, 1 << 16):
    if b"read_threads" in data:
        os.write(1, open(sys.argv[1], "rb").read())
"""


def test_where_a_node_stands_is_asked_of_its_machine_unless_that_is_gone(tmp_path: Path) -> None:
    read = ProcessThreads(problem="nobody may")
    (tmp_path / "answer").write_bytes(encode(ThreadsRead("eye", read)))
    host = Host("robot", through=(sys.executable, "-c", ANSWERS, str(tmp_path / "answer")))
    machine = Machine(host, ENDED_S, lambda severity, text: None, agent_command(host))
    try:
        assert machine.threads_of("eye") == machine.threads_of("eye") == read
        os.kill(machine.pid, signal.SIGKILL)
        wait_until(lambda: machine.lost)
        assert machine.threads_of("eye") == ProcessThreads(problem=machine.lost)
    finally:
        machine.close()


def test_a_file_that_nodes_elsewhere_need_is_named_if_it_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "plan.json").mkdir()
    host = Host("robot", through=("sh", "-c", "exec cat >/dev/null"))
    machine = Machine(host, ENDED_S, lambda severity, text: None, agent_command(host))
    start = Start("", "", "robot", (), {}, (), {})
    said = r"plan\.json cannot be read, and other machines need it: Is a directory"
    try:
        with pytest.raises(EnvironmentFault, match=said):
            machine.begin(start, tmp_path, tmp_path.glob("*.json"), lambda: connect(""))
    finally:
        machine.close()


def test_ctrl_c_ends_the_sending_of_a_project(tmp_path: Path) -> None:
    """Where a machine takes nothing any more; the launcher waits for the thread that sends."""
    project, takes_no_more = tmp_path / "project", tmp_path / "takes_no_more"
    project.mkdir()
    (project / "weights").write_bytes(bytes(1 << 22))
    agent = 'cat "$0"; head -c 100000 >/dev/null; touch "$1"; exec sleep 600'
    (tmp_path / "answer").write_bytes(encode(Lacking((("weights",), ()))))
    through = ("sh", "-c", agent, str(tmp_path / "answer"), str(takes_no_more))
    host = Host("robot", through=through)
    machine = Machine(host, ENDED_S, lambda severity, text: None, agent_command(host))
    closer = threading.Thread(target=machine.close)  # what Ctrl+C does
    with ThreadPoolExecutor(1) as threads:
        sending = threads.submit(machine.place, project)
        deadline_s = time.monotonic() + ENDED_S
        while not takes_no_more.exists() and time.monotonic() < deadline_s:
            time.sleep(0.01)
        closer.start()
        try:
            assert takes_no_more.exists()
            with pytest.raises(EnvironmentFault, match="robot: it is not needed any more"):
                sending.result(ENDED_S)
        finally:
            machine.lost = "ended"  # ends the thread, come what may
            if closer.is_alive():
                os.kill(machine.pid, signal.SIGKILL)  # else it is given some seconds
            closer.join()
