"""`neuros.Project` and `neuros.Run`: projects run by Python programs, with real rclpy."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import nbclient
import nbformat
import pytest
from api_projects import COUNTER, ENDLESS, dice

import neuros
from containers import require_containers
from neuros.backends.sessions import sessions
from neuros.errors import EnvironmentFault, ProjectError, RunError, UsageError

DEADLINE_S = 30.0
# Whoever runs these tests in the background has them, and all that they start, ignore Ctrl+C.
HEEDING = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
SEED = "nodes.thrower.environment.SEED"
EYES = "thrower.eyes -> counter.eyes"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def project(tmp_path: Path, counter: str = COUNTER) -> neuros.Project:
    return neuros.Project.from_file(dice(tmp_path, counter))


def thrown(seed: int, faces: int = 6) -> list[int]:
    """What the dice show."""
    source = random.Random(seed)
    return [source.randint(1, faces) for _ in range(10)]


# ------------------------------------------------------------------ results


def test_a_run_takes_the_options_of_launch_and_records_them(tmp_path: Path) -> None:
    run = project(tmp_path).run(
        backend="in-process", namespace="/left", placement=False, duration="9", seed=3, nodes=[]
    )
    assert run.record["namespace"] == "/left"
    asked = run.record["options"]
    told = {"backend": "in-process", "placement": False, "duration": "9", "seed": 3, "nodes": []}
    assert asked == asked | told
    assert not {"output", "verbose", "show", "check", "progress"} & {*asked}
    assert "duration: ``--duration``: end the run" in (neuros.Project.run.__doc__ or "")


def test_an_argument_that_there_is_none_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="'duratoin'"):
        project(tmp_path).run(duratoin=1)  # type: ignore[call-arg]


ACCEPTANCE = pytest.mark.acceptance
EVERY_BACK_END = ["process", "in-process", pytest.param("docker", marks=ACCEPTANCE)]


@pytest.mark.parametrize("back_end", EVERY_BACK_END)
def test_a_run_gives_what_came_out(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if back_end == "docker":
        require_containers()
    run = project(tmp_path).run(backend=back_end, seed=7, record=[EYES], output="here")
    assert (run.exit_code, run.is_ok, run.backend) == (0, True, back_end)
    assert run.reason == "counter ended the project: ten were thrown"
    assert run.folder == tmp_path / "here"
    assert run.node_results["counter"] == {"sum": sum(thrown(7)), "eyes": thrown(7)}
    assert run.connections[EYES]["consumed"] == 10
    assert list(run.bag[EYES].array()["data"])[:10] == thrown(7)
    assert [packet.data for packet in run.bag[EYES]][:10] == thrown(7)
    assert "counting" in run.log("counter")
    assert run.connection_frame().loc[EYES, "consumed"] == 10
    assert run.node_frame().loc["counter", "sum"] == sum(thrown(7))
    assert run.wall_s > 0
    assert run.sim_s is None
    assert neuros.Run(run.folder).record == run.record
    assert run.reason in str(run)
    assert "<pre>" in run._repr_html_()
    assert capsys.readouterr() == ("", ""), "nothing is printed unless it is to be shown"


def test_a_failing_node_is_an_outcome_and_an_error_where_that_is_wanted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unlucky = project(tmp_path, COUNTER.replace("== 13", "> 6"))
    unlucky = unlucky.with_settings({"nodes.thrower.environment.FACES": 10**9})
    run = unlucky.run(backend="in-process", show=True)
    assert "hook 'add': RuntimeError: thirteen eyes" in capsys.readouterr().out
    assert run.exit_code == 1
    assert "thirteen eyes" in run.reason
    with pytest.raises(RunError, match=r"thirteen eyes.*\nrun folder: ") as caught:
        run.check()
    assert caught.value.exit_code == 1


# ------------------------------------------------------------------ where it runs


def test_runs_go_on_in_threads_beside_a_running_event_loop_and_within_it(tmp_path: Path) -> None:
    made = project(tmp_path)

    async def main() -> list[neuros.Run]:
        first = asyncio.to_thread(made.run, backend="in-process", seed=1)
        second = asyncio.to_thread(made.run, backend="process", seed=2)
        settings = {"nodes.thrower.environment.FACES": 2}
        third = made.with_settings(settings).run(backend="in-process", set={SEED: "3"})
        return [*await asyncio.gather(first, second), third]

    runs = asyncio.run(main())
    expected = [thrown(1), thrown(2), thrown(3, faces=2)]
    assert [run.node_results["counter"]["eyes"] for run in runs] == expected
    assert len({run.folder for run in runs}) == 3
    assert runs[0].record["domain_id"] != runs[1].record["domain_id"]


@ACCEPTANCE
def test_a_notebook_runs_projects_and_shows_them(tmp_path: Path) -> None:
    dice(tmp_path)
    cells = [
        "import neuros, matplotlib; project = neuros.Project.from_file('dice')",
        "run = project.run(backend='in-process', show=True); run",
    ]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    kernels = nbclient.NotebookClient(notebook, timeout=60, resources={"metadata": {"path": "."}})
    kernels.execute()
    outputs: Any = notebook.cells[1].outputs
    printed = "".join(each["text"] for each in outputs if each["output_type"] == "stream")
    assert "[counter]: counting" in printed
    (shown,) = [each["data"] for each in outputs if each["output_type"] == "execute_result"]
    assert "ten were thrown" in shown["text/html"]


# ------------------------------------------------------------------ in the background


def test_a_run_in_the_background_is_drained_at_the_end_of_its_block(tmp_path: Path) -> None:
    with project(tmp_path, ENDLESS).start(backend="in-process") as live:
        _await(lambda: "counting" in _log(live.folder))
        assert live.is_running
        with pytest.raises(TimeoutError):
            live.wait(0.01)
    run = live.wait()
    assert (run.exit_code, run.reason) == (0, "stopped by the program")
    assert run.connections[EYES]["lost"] == 0
    assert not live.is_running


@ACCEPTANCE
def test_a_block_that_fails_ends_its_run_and_is_the_reason(tmp_path: Path) -> None:
    live = project(tmp_path, ENDLESS).start(backend="in-process")

    def fail_within() -> None:
        with live:
            _await(lambda: "counting" in _log(live.folder))
            raise LookupError("no map\nof here")

    with pytest.raises(LookupError):
        fail_within()
    run = live.wait()
    assert (run.exit_code, run.reason) == (7, "the program failed: LookupError: no map")


def test_neuros_stop_ends_the_run_and_not_the_program(tmp_path: Path) -> None:
    live = project(tmp_path, ENDLESS).start(backend="in-process")
    _await(lambda: "counting" in _log(live.folder))
    (run,) = [each.run for each in sessions() if each.folder == str(live.folder)]
    subprocess.run([sys.executable, "-m", "neuros.cli", "stop", run], check=True, timeout=30)
    assert live.wait(DEADLINE_S).reason == "ended by Ctrl+C"


def test_ctrl_c_ends_the_run_in_order_and_goes_on_as_keyboard_interrupt(tmp_path: Path) -> None:
    dice(tmp_path, ENDLESS)
    program = """
import neuros
try:
    neuros.Project.from_file("dice").run(backend="in-process", output="run", show=True)
except KeyboardInterrupt as interrupt:
    print("caught:", interrupt, neuros.Run("run").exit_code)
"""
    output, _ = _interrupted(program, signal.SIGINT)
    assert f"caught: the run was ended; its folder: {tmp_path / 'run'} 130" in output


@pytest.mark.parametrize(
    ("file", "function"),
    [("neuros/api/live.py", "begin"), ("threading.py", "start"), ("neuros/api/live.py", "wait")],
    ids=["before it begins", "as its thread begins", "before it is waited for"],
)
def test_ctrl_c_between_start_and_wait_leaves_nothing_running(
    tmp_path: Path, file: str, function: str
) -> None:
    made = project(tmp_path, ENDLESS)
    threads = set(threading.enumerate())
    with interrupted_at(file, function), pytest.raises(KeyboardInterrupt):
        made.run(backend="in-process", output="run")
    _await(lambda: set(threading.enumerate()) <= threads)
    assert str(tmp_path / "run") not in {each.folder for each in sessions()}
    assert not [each for each in open_files() if "neuros-domain-" in each]


def test_a_run_that_cannot_be_observed_leaves_no_guardian(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = project(tmp_path)

    def fail(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("neuros.recording.provenance.GitState.__init__", fail)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        made.run(backend="in-process", output="run")
    assert str(tmp_path / "run") not in {each.folder for each in sessions()}


@ACCEPTANCE
def test_a_program_that_ends_ends_its_run(tmp_path: Path) -> None:
    dice(tmp_path, ENDLESS)
    program = """
import neuros, pathlib, time
live = neuros.Project.from_file("dice").start(backend="in-process", output="run")
log = pathlib.Path("run/counter/node.log")
while not (log.exists() and "counting" in log.read_text()):
    time.sleep(0.01)
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=DEADLINE_S)
    assert neuros.Run("run").exit_code == 130


# ------------------------------------------------------------------ errors


def test_errors_are_exceptions_of_neuros(tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match=r"project.json: there is no such file"):
        neuros.Project.from_file("nowhere/project.json")
    made = project(tmp_path)
    with pytest.raises(ProjectError, match="no node 'nobody'"):
        made.run(set={"nodes.nobody.script": "x"})
    with pytest.raises(UsageError, match="back end 'spaceship': choose one of auto, docker"):
        made.run(backend="spaceship")
    with pytest.raises(UsageError, match="is not an empty folder"):
        made.run(backend="in-process", output=tmp_path)
    with pytest.raises(UsageError, match="give seconds"):
        made.run(duration="soon")
    with pytest.raises(UsageError, match="no such topic, connection or output"):
        made.run(backend="in-process", record=["nothing"], duration=1)
    content = json.loads((tmp_path / "dice/project.json").read_text())
    del content["nodes"][0]["environment"]
    (tmp_path / "dice/project.json").write_text(json.dumps(content))
    with pytest.raises(UsageError, match="no node of dice has an environment variable with SEED"):
        made.run(seed=1)


def test_a_python_program_does_not_leave_its_network_for_a_run(tmp_path: Path) -> None:
    project = neuros.Project.from_file(dice(tmp_path))
    with pytest.raises(UsageError, match="use backend='docker', or `neuros launch --isolate`"):
        project.run(isolate=True, backend="process")


def test_a_run_that_cannot_start_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = project(tmp_path)

    def fail(*_: object) -> None:
        raise OSError("too many of them")

    monkeypatch.setattr("neuros.backends.guardian.Guardian.spawn", fail)
    with pytest.raises(EnvironmentFault, match="cannot start the process of thrower"):
        made.run(backend="in-process", output="run")
    assert neuros.Run("run").exit_code == 4


def test_a_project_is_looked_at_without_running_it(tmp_path: Path) -> None:
    made = project(tmp_path)
    assert made.name == "dice"
    assert made.nodes == ("thrower", "counter")
    assert made.connections == (EYES,)
    assert made.validate() == ()
    assert "flowchart" in made.graph("mermaid")
    assert "-> counter.eyes" in made.graph()
    (tmp_path / "dice/project.json").write_text('{"nodes": 1}')
    with pytest.raises(ProjectError):
        made.validate()


# ------------------------------------------------------------------ helpers


def _log(folder: Path) -> str:
    file = folder / "counter/node.log"
    return file.read_text() if file.exists() else ""


@contextlib.contextmanager
def interrupted_at(file: str, function: str) -> Iterator[None]:
    """Ctrl+C, once, as this thread enters a function that has to do with a run."""

    places = []

    def profile(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code.co_name != function or not code.co_filename.endswith(file):
            return
        if getattr(frame.f_locals["self"], "name", "neuros-run") == "neuros-run":
            sys.setprofile(None)
            places.append(function)
            raise KeyboardInterrupt

    sys.setprofile(profile)
    try:
        yield
    finally:
        sys.setprofile(None)
    assert places, f"{function} was not called"


def open_files() -> list[str]:
    """What this process has open."""
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found.append(os.readlink(link))
    return found


def _await(condition: Any) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def _interrupted(program: str, number: int) -> tuple[str, int]:
    """The output and exit code of a program that gets a signal when its nodes are counting."""
    with subprocess.Popen(
        [sys.executable, "-u", "-c", HEEDING + program], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        killer = threading.Timer(DEADLINE_S, process.kill)
        killer.start()
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "counting" in line:
                os.kill(process.pid, number)
        killer.cancel()
    return "".join(lines), process.returncode
