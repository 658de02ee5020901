"""Simulators behind ``simulation_interfaces``: NeuROS drives one, and is one, over real ROS.

The package is nowhere to be had by pip. These tests take that of a ROS distribution, or of the
folder that the variable ``SIMULATION_INTERFACES`` names; without it, they are skipped.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from launching import EXAMPLES, Finished, launch, start
from plain_programs import plain_program
from ros_program import RosProgram

from neuros.backends.domain import choose_domain
from neuros.cli.main import main
from neuros.installation.progress import Progress
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces

PACKAGE = "simulation_interfaces"
WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
HERE = Path(__file__).parent / "standard"
LIMIT_S = 120.0


@pytest.fixture(scope="module")
def interfaces(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """The folder of the package, built and on Python's path; ``None`` if it comes with ROS."""
    if find_spec(PACKAGE) is not None:
        return None
    given = os.environ.get("SIMULATION_INTERFACES")
    if not given:
        pytest.skip(f"there is no package {PACKAGE}: name its folder in SIMULATION_INTERFACES")
    folder = tmp_path_factory.mktemp("interfaces") / "workspace" / PACKAGE
    shutil.copytree(given, folder)
    return folder


@pytest.fixture(scope="module")
def python_path(interfaces: Path | None) -> Iterator[str]:
    """Where Python finds the built package, in this process, too."""
    if interfaces is None:
        yield ""
        return
    messages = Messages(Workspaces(interfaces.parent, None, os.environ), [PACKAGE])
    messages.make(Progress(io.StringIO()), os.environ)
    (folder,) = messages.paths
    sys.path.append(str(folder))
    yield str(folder)
    sys.path.remove(str(folder))


@pytest.fixture
def whiskeye(interfaces: Path | None, tmp_path: Path) -> Path:
    """The example, with the package in its workspace."""
    folder = tmp_path / "whiskeye"
    shutil.copytree(WHISKEYE, folder, ignore=shutil.ignore_patterns("runs", "workspace"))
    if interfaces is not None:
        shutil.copytree(interfaces.parent, folder / "workspace")
    return folder


@contextlib.contextmanager
def simulator(python_path: str, file: Path, **environment: str) -> Iterator[int]:
    """A simulator that is a plain program; its ROS domain."""
    with (
        choose_domain(None, {}, False) as domain,
        plain_program(file, domain.id, PYTHONPATH=python_path, **environment),
    ):
        yield domain.id


def run(project: Path, domain: int, *arguments: str, timeout_s: float = 60.0) -> Finished:
    settings = {"domain": domain, "timeout_s": timeout_s}
    options = [f"nodes.robot.parameters.{name}={value}" for name, value in settings.items()]
    given = [word for option in options for word in ("--set", option)]
    return launch(
        project / "outside.json", "--duration", "2sim", "--digests", *given, *arguments,
        cwd=project.parent,
    )  # fmt: skip


class TestLockstep:
    def test_runs_of_a_simulator_that_is_a_plain_program_are_identical(
        self, whiskeye: Path, python_path: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """WhiskEye's network, on two back ends; the simulator goes on all the time."""
        folders = []
        with simulator(python_path, WHISKEYE / "outside_simulator.py") as domain:
            for back_end in ("process", "process", "in-process"):
                finished = run(whiskeye, domain, "--backend", back_end)
                assert finished.exit_code == 0, finished.output
                assert finished.connection("robot.imu -> snn.imu")["consumed"] == 100
                folders.append(str(finished.run_folder))
        for folder in folders[1:]:
            assert main(["verify", folders[0], folder]) == 0
            assert capsys.readouterr().out == "identical: 300 packets\n"

    @pytest.mark.parametrize(
        ("fault", "text"),
        [
            ("leaves", "/step_simulation: the simulator has gone away before it answered"),
            # DDS misses a killed program after 20 s at the earliest.
            ("dies", "/step_simulation: the simulator has not answered within 15 s"),
            ("answers", "simulator answers RESULT_OPERATION_FAILED: the solver has diverged"),
            ("steps less", "the simulator's time is 0.059 s, and 0.06 s is expected: 'step_s'"),
            ("lacks features", "GetSimulatorFeatures): STEP_SIMULATION_SINGLE, SIMULATION_RESET"),
        ],
    )
    def test_a_simulator_that_fails_ends_the_run_by_name(
        self, whiskeye: Path, python_path: str, fault: str, text: str
    ) -> None:
        program = HERE / "simulator.py"
        with simulator(python_path, program, FAULT=fault, EXAMPLE=str(WHISKEYE)) as domain:
            # One message fewer is not noticed where the time is wrong, too.
            topics = ["--set", "nodes.robot.parameters.every.imu=1000"] * (fault == "steps less")
            finished = run(whiskeye, domain, "--backend", "process", *topics, timeout_s=15.0)
        assert finished.exit_code == 1
        assert text in finished.output

    def test_without_a_simulator_the_error_says_where_it_was_looked_for(
        self, whiskeye: Path, python_path: str
    ) -> None:
        with choose_domain(None, {}, False) as domain:
            finished = run(whiskeye, domain.id, "--backend", "process", timeout_s=2.0)
        assert finished.exit_code == 1
        text = f"no simulator serves this in ROS domain {domain.id} after 2 s: start it, or give"
        assert text in finished.output

    def test_a_prefix_that_is_missing_and_a_topic_that_nobody_publishes_are_named(
        self, whiskeye: Path, python_path: str
    ) -> None:
        with simulator(python_path, WHISKEYE / "outside_simulator.py") as domain:
            prefix = run(
                whiskeye, domain, "--set", "nodes.robot.parameters.simulator=gz", timeout_s=5.0
            )
            topic = run(
                whiskeye, domain, "--set", "nodes.robot.parameters.topics.imu=/imv", timeout_s=5.0
            )
        assert "there is /get_simulator_features: 'simulator' in the parameters" in prefix.output
        assert "'imu': no simulator publishes on /imv" in topic.output


class Asker:
    """Calls the services of the simulator under test."""

    def __init__(self, program: RosProgram) -> None:
        import simulation_interfaces.msg
        import simulation_interfaces.srv

        self.msg, self.srv = simulation_interfaces.msg, simulation_interfaces.srv
        self._program = program

    def ask(self, kind: str, **fields: Any) -> Any:
        service = getattr(self.srv, kind)
        name = "".join(f"_{c.lower()}" if c.isupper() else c for c in kind).lstrip("_")
        request = service.Request(**fields)
        return self._program.call(service, f"/box_world/{name}", request, 60.0)

    def refused(self, kind: str, **fields: Any) -> tuple[int, str]:
        result = self.ask(kind, **fields).result
        return result.result, result.error_message

    def set_state(self, name: str) -> int:
        state = self.msg.SimulationState(state=getattr(self.msg.SimulationState, name))
        return int(self.ask("SetSimulationState", state=state).result.result)

    def time_s(self) -> float:
        return float(self.ask("GetEntityState", entity="box").state.header.stamp.nanosec / 1e9)

    def features(self) -> set[int]:
        return {*self.ask("GetSimulatorFeatures").features.features}


@contextlib.contextmanager
def served(project: Path, *arguments: str) -> Iterator[Asker]:
    """The project of a simulator that serves the standard, at work; stopped at the end."""
    with (
        choose_domain(None, {}, False) as domain,
        RosProgram(domain_id=domain.id) as program,
        start(project, "--backend", "process", "-d", str(domain.id), *arguments, cwd=project)
        as running,
    ):  # fmt: skip
        yield Asker(program)
        running.process.send_signal(2)
        assert running.finish(LIMIT_S).exit_code == 130, running.output
        assert "Traceback" not in running.output


@pytest.fixture
def project(interfaces: Path | None, python_path: str, tmp_path: Path) -> Path:
    folder = tmp_path / "standard"
    shutil.copytree(HERE, folder)
    if interfaces is not None:
        shutil.copytree(interfaces.parent, folder / "workspace")
    return folder


class TestServedSimulators:
    @pytest.fixture(params=["0", "1"], ids=["its own thread steps it", "a hook steps it"])
    def asker(self, project: Path, request: pytest.FixtureRequest) -> Iterator[Asker]:
        with served(project, "--set", f"nodes.world.environment.HOOK={request.param}") as asker:
            yield asker

    def test_it_makes_exactly_the_steps_that_are_asked_for(self, asker: Asker) -> None:
        ok = asker.msg.Result.RESULT_OK
        assert asker.ask("GetSimulationState").state.state == asker.msg.SimulationState.STATE_PAUSED
        for steps, time_s in ((1, 0.002), (12, 0.026), (1, 0.028)):
            assert asker.refused("StepSimulation", steps=steps) == (ok, "")
            assert asker.time_s() == pytest.approx(time_s)

    def test_entities_are_found_read_and_set(self, asker: Asker) -> None:
        assert asker.ask("GetEntities").entities == ["box", "arm", "wall"]
        filters = asker.msg.EntityFilters(filter="^b|wa")
        assert asker.ask("GetEntitiesStates", filters=filters).entities == ["box", "wall"]
        categories = [
            asker.ask("GetEntityInfo", entity=name).info.category.category
            for name in ("box", "arm", "wall")
        ]
        kind = asker.msg.EntityCategory
        assert categories == [
            *(kind.CATEGORY_DYNAMIC_OBJECT, kind.CATEGORY_ROBOT, kind.CATEGORY_STATIC_OBJECT)
        ]
        state = asker.ask("GetEntityState", entity="box").state
        assert (state.header.frame_id, state.pose.position.z) == ("world", 1.0)
        # Turned about x by 90 degrees, and about the world's z it goes on turning.
        state.pose.position.z, state.twist.angular.z, state.twist.linear.x = 3.0, 2.0, 1.0
        state.pose.orientation.w = state.pose.orientation.x = 0.5**0.5
        flags = {f"set_{part}": True for part in ("pose", "twist")}
        asker.ask("SetEntityState", entity="box", state=state, **flags)
        found = asker.ask("GetEntityState", entity="box").state
        assert found.pose.position.z == 3.0
        assert found.twist.angular.z == pytest.approx(2.0)
        assert (found.twist.linear.x, found.twist.angular.y) == (1.0, pytest.approx(0.0))

    def test_what_cannot_be_done_is_refused_by_name(self, asker: Asker) -> None:
        result = asker.msg.Result
        code, text = asker.refused("GetEntityState", entity="bax")
        assert (code, text) == (
            result.RESULT_NOT_FOUND,
            "there is no body 'bax' (entities: box, arm, wall)",
        )
        state = asker.ask("GetEntityState", entity="arm").state
        code, text = asker.refused("SetEntityState", entity="arm", state=state, set_pose=True)
        assert (code, "no free joint" in text) == (result.RESULT_OPERATION_FAILED, True)
        state.twist.linear.x = float("nan")
        code, text = asker.refused("SetEntityState", entity="box", state=state, set_twist=True)
        assert (code, "cannot have" in text) == (result.RESULT_OPERATION_FAILED, True)
        state.twist.linear.x = 0.0
        state.pose.orientation.w = 7.0
        code, _ = asker.refused("SetEntityState", entity="box", state=state, set_pose=True)
        assert code == asker.srv.SetEntityState.Response.INVALID_POSE
        state.header.frame_id = "arm"
        code, _ = asker.refused("SetEntityState", entity="box", state=state, set_pose=True)
        assert code == result.RESULT_FEATURE_UNSUPPORTED
        code, text = asker.refused("GetEntities", filters=asker.msg.EntityFilters(filter="("))
        assert (code, "filter: missing )" in text) == (result.RESULT_OPERATION_FAILED, True)

    def test_it_is_played_and_paused_and_steps_of_one_that_plays_are_refused(
        self, asker: Asker
    ) -> None:
        response = asker.srv.SetSimulationState.Response
        assert asker.set_state("STATE_PAUSED") == response.ALREADY_IN_TARGET_STATE
        assert asker.set_state("STATE_PLAYING") == asker.msg.Result.RESULT_OK
        code, text = asker.refused("StepSimulation", steps=1)
        assert code == asker.msg.Result.RESULT_OPERATION_FAILED
        assert text == "the simulation is not paused: set STATE_PAUSED first"
        assert asker.set_state("STATE_QUITTING") == asker.msg.Result.RESULT_FEATURE_UNSUPPORTED

    def test_an_action_steps_it_too_and_tells_of_each_step(self, asker: Asker) -> None:
        from rclpy.action import ActionClient
        from simulation_interfaces.action import SimulateSteps

        program = asker._program
        client = ActionClient(program.node, SimulateSteps, "/box_world/simulate_steps")
        program.spin_until(client.server_is_ready, 60.0)
        told: list[int] = []
        goal = client.send_goal_async(
            SimulateSteps.Goal(steps=4), lambda each: told.append(each.feedback.completed_steps)
        )
        program.spin_until(goal.done, 60.0)
        result = goal.result().get_result_async()
        program.spin_until(result.done, 60.0)
        assert result.result().result.result.result == asker.msg.Result.RESULT_OK
        # rclpy drops feedback that overtakes the acceptance of the goal.
        assert told == sorted({*told} & {1, 2, 3, 4})
        assert asker.time_s() == 0.008
        client.destroy()


def test_one_that_steps_itself_is_reset_and_one_that_a_hook_steps_is_not(project: Path) -> None:
    for hook in ("0", "1"):
        with served(project, "--set", f"nodes.world.environment.HOOK={hook}") as asker:
            kind = asker.msg.SimulatorFeatures
            has_reset = kind.SIMULATION_RESET in asker.features()
            asker.ask("StepSimulation", steps=5)
            code, text = asker.refused("ResetSimulation")
            if hook == "0":
                assert (has_reset, code, text) == (True, asker.msg.Result.RESULT_OK, "")
                assert asker.time_s() == 0
            else:
                assert (has_reset, code) == (False, asker.msg.Result.RESULT_FEATURE_UNSUPPORTED)
                assert "in lockstep with other nodes: reset the project, in a session" in text
                assert asker.time_s() == 0.01


def test_in_virtual_time_nobody_outside_steps(project: Path) -> None:
    description = json.loads((project / "project.json").read_text())
    (node,) = description["nodes"]
    node["environment"] = {"HOOK": "1"}
    del node["inputs"]
    for port in node["outputs"]:
        del port["external_topic"]
    (project / "project.json").write_text(json.dumps(description))
    finished = launch(project, "--time", "virtual", "--backend", "process", cwd=project)
    assert finished.exit_code == 1
    assert "in virtual time, nobody outside can step a simulator: leave" in finished.output
