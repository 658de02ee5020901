"""``neuros fork RUN``: executed again up to a moment, then on to its end, changed or not."""

from __future__ import annotations

import json
import re
import shutil
import signal
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest
from commands import neuros
from launching import BACKENDS, Finished, launch, start

ROBOT = """\
import os

from neuros.hooks import Optional, neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

WORLD = '''<mujoco><option timestep="0.01"/><worldbody><body name="b">
<joint name="j" type="hinge" axis="0 1 0" pos="0 0 .2"/><geom type="capsule" size=".02 .2"/></body>
</worldbody><actuator><motor name="m" joint="j"/></actuator>
<sensor><jointpos name="angle" joint="j"/></sensor></mujoco>'''


@neuros_initialise(outputs="angle")
def begin(node):
    sim = MuJoCo(node, WORLD)
    node.set_user_data(sim)
    return node.make_packet("angle")


@neuros_function(inputs="torque", outputs="angle")
def step(node, torque):
    sim = node.get_user_data()
    sim.actuate("m", torque.data)
    sim.step_to_next()
    if sim.sim_time > float(os.environ["END"]):
        node.shutdown("done")
    return sim.read("angle")
"""
BRAIN = """\
import os

from neuros.hooks import neuros_function


@neuros_function(inputs="angle", outputs="torque")
def think(node, angle):
    torque = node.make_packet("torque")
    torque.data = float(os.environ["GAIN"]) * (0.3 - angle.data)
    return torque
"""
RUNS_BY_ITSELF = (
    ROBOT[: ROBOT.index("@neuros_init")]
    + """\
from neuros.hooks import neuros_tick


@neuros_initialise()
def begin(node):
    sim = MuJoCo(node, WORLD)
    node.set_user_data(sim)
    sim.run_asynchronous(1.0)


@neuros_function(inputs="torque")
def obey(node, torque):
    node.get_user_data().actuate("m", torque.data)


@neuros_tick(0.013)
def watch(node):
    if node.get_user_data().sim_time > float(os.environ["END"]):
        node.shutdown("done")
"""
)
RATE_HZ = 50
VIRTUAL = ("--time", "virtual")


def write_project(folder: Path, *, is_strict: bool = True) -> Path:
    """A loop of a swinging body and its controller: strict, or one that may lose packets."""
    folder.mkdir()
    (folder / "robot.py").write_text(ROBOT)
    (folder / "brain.py").write_text(BRAIN)
    number = {"type": "std_msgs/msg/Float64"}
    sensor = {"mujoco": {"sensor": "reading", "element": "angle", "rate": RATE_HZ}}
    robot: dict[str, Any] = {"name": "robot", "container": "neuros_mujoco", "plugin": "robot.py"}
    robot |= {"inputs": [{"name": "torque", **number}], "environment": {"END": 0.99}}
    robot |= {"outputs": [{"name": "angle", **number, **sensor}]}
    brain: dict[str, Any] = {"name": "brain", "container": "neuros_python", "plugin": "brain.py"}
    brain |= {"inputs": [{"name": "angle", **number}], "outputs": [{"name": "torque", **number}]}
    brain["outputs"].append({"name": "spare", **number})
    brain |= {"environment": {"GAIN": 1}}
    wires = [("robot", "angle", "brain"), ("brain", "torque", "robot")]
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    limit = {"discard_limit": 0} if is_strict else {}
    connections = [
        {**dict(zip(keys, (a, port, b, port), strict=True)), **limit} for a, port, b in wires
    ]
    if not is_strict:
        (folder / "robot.py").write_text(RUNS_BY_ITSELF)
        brain["durations"] = {"think": {"uniform": [0.005, 0.06]}}
        brain["environment"]["SEED"] = 3
    project = {"nodes": [robot, brain], "connections": connections}
    (folder / "project.json").write_text(json.dumps(project))
    return folder


def recorded(folder: Path, *options: str) -> Finished:
    project = write_project(folder / "project", is_strict=VIRTUAL[1] not in options)
    run = launch(project, *options, "-r", cwd=folder, timeout_s=120.0)
    assert run.exit_code == 0, run.output
    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = recorded(tmp_path_factory.mktemp("run"), "--backend", "process").run_folder
    assert found is not None
    return found


@pytest.fixture(scope="module", params=BACKENDS)
def virtual_run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of physics that runs by itself, ticks and losses, in virtual time."""
    found = recorded(tmp_path_factory.mktemp("run"), *VIRTUAL, "--backend", request.param)
    assert found.run_folder is not None
    brain = found.record["nodes"]["brain"]["hooks"]["think"]["executions"]
    assert 10 < brain < found.connection("robot.angle -> brain.angle")["sent"] - 5
    return found.run_folder


@pytest.fixture
def own(run: Path, tmp_path: Path) -> Path:
    """The same run, with a project that a test may change."""
    project = run.parents[2] / "project"
    shutil.copytree(project, tmp_path / "project")
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("*.sock"))
    for file in (*(tmp_path / "run").glob("*/node.json"), tmp_path / "run/run.json"):
        file.write_text(file.read_text().replace(str(project), str(tmp_path / "project")))
    return tmp_path / "run"


def fork(run: Path, output: Path, *options: object) -> CompletedProcess[str]:
    return neuros("fork", run, "-o", output, *options)


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_unchanged_fork_is_identical_to_its_end(backend: str, run: Path, tmp_path: Path) -> None:
    if backend != "process":
        own = recorded(tmp_path, "--backend", backend).run_folder
        assert own is not None
        run = own
    done = fork(run, tmp_path / "fork", "--at", "0.5sim")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^identical up to 0\.5 s: (51|52) packets$", done.stdout, re.M), done.stdout
    verdict = neuros("verify", run, tmp_path / "fork")
    assert verdict.returncode == 0, verdict.stdout
    assert json.loads((tmp_path / "fork/run.json").read_text())["backend"] == backend


@pytest.mark.parametrize(
    "setting", ["nodes.brain.environment.GAIN=3", "robot.model.dof_damping=0.5"]
)
def test_a_changed_fork_differs_only_after_its_time(
    run: Path, tmp_path: Path, setting: str
) -> None:
    done = fork(run, tmp_path / "fork", "--at", "0.5sim", "--set", setting)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "identical up to 0.5 s: " in done.stdout
    verdict = neuros("verify", run, tmp_path / "fork")
    assert verdict.returncode == 1, verdict.stdout
    found = re.search(r"different: .*: packet (\d+) differs", verdict.stdout)
    assert found is not None
    assert int(found[1]) >= 0.5 * RATE_HZ + 1


def test_in_virtual_time_an_unchanged_fork_is_identical_to_its_end(
    virtual_run: Path, tmp_path: Path
) -> None:
    done = fork(virtual_run, tmp_path / "fork", "--at", "0.5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^identical up to 0\.5 s: [2-9]\d packets$", done.stdout, re.M), done.stdout
    verdict = neuros("verify", virtual_run, tmp_path / "fork")
    assert verdict.returncode == 0, verdict.stdout
    assert neuros("replay", tmp_path / "fork").returncode == 0


@pytest.mark.parametrize(
    "setting", ["nodes.brain.environment.GAIN=3", "robot.model.dof_damping=0.5"]
)
def test_in_virtual_time_a_changed_fork_differs_only_after_its_time(
    virtual_run: Path, tmp_path: Path, setting: str
) -> None:
    done = fork(virtual_run, tmp_path / "fork", "--at", "0.5", "--set", setting)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "identical up to 0.5 s: " in done.stdout
    verdict = neuros("verify", virtual_run, tmp_path / "fork")
    assert verdict.returncode == 1, verdict.stdout
    record = json.loads((tmp_path / "fork/run.json").read_text())
    assert record["fork"]["at_s"] == 0.5


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--at", "0.5sim"], "it is in virtual time: give seconds of virtual time, as in 12.4"),
        (["--at", "9"], "s of its clock: fork it before"),
        (["--at", "0.5", "--set", "robot.model.dof_dampin=1"], "no field 'dof_dampin'"),
    ],
)
def test_what_users_mistype_of_virtual_time(
    virtual_run: Path, tmp_path: Path, options: list[str], says: str
) -> None:
    done = fork(virtual_run, tmp_path / "fork", *options)
    assert done.returncode in (1, 2), done.stdout + done.stderr
    assert says in done.stderr
    assert "identical" not in done.stdout


@pytest.fixture(scope="module")
def changed(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("changed") / "fork"
    done = fork(run, folder, "--at", ".3sim", "--set", "nodes.brain.environment.GAIN=3")
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_record_tells_what_it_is_a_fork_of(run: Path, changed: Path) -> None:
    record = json.loads((changed / "run.json").read_text())
    assert record["fork"] == {
        "run": str(run),
        "run_id": json.loads((run / "run.json").read_text())["run_id"],
        "at_sim_s": 0.3,
        "set": {"nodes.brain.environment.GAIN": "3"},
    }
    assert record["options"]["record"] is True
    assert record["expanded_project"]["nodes"][1]["environment"]["GAIN"] == "1"


def test_a_fork_of_a_fork(run: Path, tmp_path: Path) -> None:
    fork(run, tmp_path / "first", "--at", "0.3sim")
    done = fork(tmp_path / "first", tmp_path / "second", "--at", "0.6sim")
    assert done.returncode == 0, done.stdout + done.stderr
    assert neuros("verify", run, tmp_path / "second").returncode == 0


def test_a_fork_that_was_changed_cannot_be_executed_again_by_its_project(
    changed: Path, tmp_path: Path
) -> None:
    done = fork(changed, tmp_path / "second", "--at", "0.6sim")
    assert done.returncode == 2, done.stdout + done.stderr
    assert "it is a fork with settings itself: name the run that it began with" in done.stderr


def test_a_plugin_that_was_changed_meanwhile_is_found_out(own: Path, tmp_path: Path) -> None:
    (tmp_path / "project/brain.py").write_text(BRAIN.replace("0.3 - angle", "0.31 - angle"))
    done = fork(own, tmp_path / "fork", "--at", "0.5sim")
    assert done.returncode == 6, done.stdout + done.stderr
    says = "different before 0.5 s: brain.torque -> robot.torque: packet 1 differs in data: 0.3 in"
    assert says in done.stdout


def test_a_project_that_was_changed_meanwhile_is_refused(own: Path, tmp_path: Path) -> None:
    file = tmp_path / "project/project.json"
    file.write_text(file.read_text().replace('"GAIN": 1', '"GAIN": 2'))
    done = fork(own, tmp_path / "fork", "--at", "0.5sim")
    assert done.returncode == 2, done.stdout + done.stderr
    assert f"{file} was changed after the run" in done.stderr
    assert not (tmp_path / "fork").exists()


def test_all_reasons_are_named_at_once(own: Path, tmp_path: Path) -> None:
    ticks = "\n\n@neuros_tick(0.1)\ndef look(node):\n    pass\n"
    (tmp_path / "project/brain.py").write_text(
        BRAIN.replace("import neuros_function", "import neuros_function, neuros_tick") + ticks
    )
    record = json.loads((own / "run.json").read_text())
    record |= {"sim_s": 0.4, "options": {**record["options"], "duration": 3}}
    (own / "run.json").write_text(json.dumps(record))
    done = fork(own, tmp_path / "fork", "--at", "0.5sim")
    assert done.returncode == 2, done.stdout + done.stderr
    project = tmp_path / "project/project.json"
    warning, *lines = done.stderr.splitlines()
    assert warning.startswith(f"warning: {project}:1:"), done.stderr
    assert warning.endswith("output 'spare' of node 'brain' is not connected"), done.stderr
    assert lines == [
        f"neuros: {own} cannot be forked:",
        "  brain, hook 'look': ticks by the wall clock: let it tick by simulated time"
        " (sim_seconds)",
        "  it ended at 0.4 s of simulated time: fork it before",
        "  it ends after a wall time: give --duration with simulated seconds (30sim)",
    ]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--at", "0.5"], "--at 0.5: it is in real time: give simulated seconds, as in 12.4sim"),
        (["--at", "soon"], "--at soon: give simulated seconds"),
        (["--at", "0sim"], "--at 0sim: give simulated seconds above 0"),
        ([], "name it on the command line, it is missing: --at"),
        (["--at", "0.5sim", "--set", "nodes.brain"], "--set nodes.brain: write PATH=VALUE"),
        (
            ["--at", "0.5sim", "--set", "nodes.brain.plugin=x.py"],
            "set: nodes.brain.plugin: a fork changes nodes.NODE.environment.VARIABLE",
        ),
        (
            ["--at", "0.5sim", "--set", "robt.model.opt.gravity=0"],
            "has no node 'robt' (did you mean 'robot'?)",
        ),
        (["--at", "2sim"], "it ended at 1 s of simulated time: fork it before"),
    ],
)
def test_what_users_mistype(run: Path, tmp_path: Path, options: list[str], says: str) -> None:
    done = fork(run, tmp_path / "fork", *options)
    assert done.returncode == 2, done.stdout + done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "fork").exists()


def test_a_field_that_the_model_lacks_ends_the_fork_before_it_goes_on(
    run: Path, tmp_path: Path
) -> None:
    settings = ("--set", "robot.model.dof_dampin=0.5")
    done = fork(run, tmp_path / "fork", "--at", "0.5sim", *settings)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "the model has no field 'dof_dampin' with numbers (did you mean" in done.stderr
    assert json.loads((tmp_path / "fork/run.json").read_text())["sim_s"] == 0.0


def test_ctrl_c_in_the_run_asks_for_an_end(tmp_path: Path) -> None:
    project = write_project(tmp_path / "project")
    endless = ("--set", "nodes.robot.environment.END=1e9")
    with start(project, "--backend", "process", *endless, cwd=tmp_path) as running:
        running.wait_for("to look into it", timeout_s=60.0)
        (folder,) = (tmp_path / "runs").glob("*/*")
        while not [*folder.glob("robot/packets/*")]:
            running.read(0.1)
        running.signal(signal.SIGINT)
        assert running.finish().exit_code == 130
    done = fork(folder, tmp_path / "fork", "--at", "0.1sim")
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Ctrl+C" in done.stderr
    assert "give --duration with simulated seconds (30sim)" in done.stderr
    done = fork(folder, tmp_path / "fork", "--at", "0.1sim", "--duration", "0.3sim")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "identical up to 0.1 s: " in done.stdout
