"""Ports of arrays: the same packets on every back end, in bags, in a replay and on ROS topics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from launching import BACKENDS, Finished, launch, start
from replaying import replay
from ros_program import RosProgram
from std_msgs.msg import Float32MultiArray

import neuros.bag
from containers import require_containers
from neuros.backends.domain import choose_domain
from neuros.cli.main import main

PROJECT = Path(__file__).parent / "arrays"
ROUNDS = 40
LENGTHS = {"state": (3,), "picture": (200, 200, 3)}

Run = Callable[[str], Path]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A recorded run on a back end, made once."""
    folders: dict[str, Path] = {}

    def run_on(back_end: str) -> Path:
        if back_end not in folders:
            cwd = tmp_path_factory.mktemp(back_end)
            finished: Finished = launch(PROJECT, "--backend", back_end, "-r", cwd=cwd)
            assert finished.exit_code == 0, finished.output
            assert finished.run_folder is not None
            folders[back_end] = finished.run_folder
        return folders[back_end]

    return run_on


@pytest.mark.parametrize("back_end", [*BACKENDS, "docker"])
def test_the_bag_has_messages_of_ros_with_the_shape_of_the_arrays(run: Run, back_end: str) -> None:
    if back_end == "docker":
        require_containers()
    with neuros.bag.open(run(back_end)) as bag:
        state = bag["plant.state"]
        assert state.type == "std_msgs/msg/Float64MultiArray"
        assert bag["plant.picture"].type == bag["/lit"].type == "std_msgs/msg/UInt8MultiArray"
        for name, shape in LENGTHS.items():
            numbers = bag[f"plant.{name}"].array()["data"]
            assert numbers.shape[1:] == shape
        states = state.array()["data"]
        assert states[0].tolist() == [1.0, -2.0, 0.5]  # what the plant has changed since is later
        assert np.array_equal(states[1:, :2], states[:-1, :2] + 0.1 * -states[:-1, :2])
        lit = bag["/lit"].array()["data"]
        assert [int(row.argmax()) for row in lit[: ROUNDS + 1]] == [*range(ROUNDS + 1)]


@pytest.mark.parametrize("back_end", [*BACKENDS[1:], "docker"])
def test_runs_on_all_back_ends_are_identical(
    run: Run, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if back_end == "docker":
        require_containers()
    assert main(["verify", str(run("process")), str(run(back_end))]) == 0
    assert capsys.readouterr().out.startswith("identical: ")


@pytest.mark.parametrize("name", ["plant", "brain"])
def test_every_node_sends_the_same_again_in_a_replay(run: Run, name: str) -> None:
    done = replay(run("process"), name)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("identical: ")


@pytest.mark.parametrize("back_end", BACKENDS)
def test_programs_of_ros_send_and_hear_ordinary_messages(back_end: str, tmp_path: Path) -> None:
    with (
        choose_domain(None, {}, False) as domain,
        RosProgram(domain_id=domain.id) as program,
    ):
        lit = program.listen("/lit", "std_msgs/msg/UInt8MultiArray")
        states = program.listen(
            "/neuros/plant/state/brain/state/data", "std_msgs/msg/Float64MultiArray"
        )
        push = program.node.create_publisher(Float32MultiArray, "/push", 10)
        endless = ("--set", "nodes.plant.environment.ROUNDS=-1")
        arguments = ("--backend", back_end, "-d", str(domain.id), *endless)
        with start(PROJECT, *arguments, cwd=tmp_path) as running:

            def is_pushed() -> bool:
                push.publish(Float32MultiArray(data=[1.0, 2.0, 3.0, 4.0]))
                return bool(lit and states and states[-1].data[2] == 10.0)

            program.spin_until(is_pushed, 60.0)
            assert [dim.size for dim in states[-1].layout.dim] == [3]
            assert [dim.size for dim in lit[-1].layout.dim] == [200]
            assert set(lit[-1].data) <= {0, 1}
            wrong = "/push: a packet is left out, and others like it: "

            def is_refused() -> bool:
                push.publish(Float32MultiArray(data=[1.0]))
                running.read(0.1)
                return wrong in running.output

            program.spin_until(is_refused, 60.0)
            running.wait_for("are not a float32[2,2]: it has 1 numbers")
        assert "failed" not in running.output
