"""Our back ends pass the checks of all back ends; and ROS programs reach the nodes on each."""

from __future__ import annotations

from pathlib import Path

import pytest
from back_end_checks import PROJECTS, BackEndChecks
from launching import BACKENDS, start
from ros_program import RosProgram
from std_msgs.msg import Int32
from std_srvs.srv import SetBool, Trigger

from containers import require_containers
from neuros.backends.domain import choose_domain

TIMEOUT_S = 60.0


class TestProcesses(BackEndChecks):
    back_end = "process"


class TestOneProcess(BackEndChecks):
    back_end = "in-process"


class TestOneProcessWithoutRos(BackEndChecks):
    back_end = "in-process"
    options = ("--no-ros",)


class TestContainers(BackEndChecks):
    back_end = "docker"

    @pytest.fixture(autouse=True)
    def containers(self) -> None:
        require_containers()


@pytest.fixture(params=[*BACKENDS, "docker"])
def back_end(request: pytest.FixtureRequest) -> str:
    if request.param == "docker":
        require_containers()
    return str(request.param)


def test_external_topics_services_and_timers_are_served_between_hooks(
    back_end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with choose_domain(None, {}, False) as domain:
        arguments = ("--backend", back_end, "-d", str(domain.id))
        with (
            RosProgram(domain_id=domain.id) as program,
            start(PROJECTS / "outside", *arguments, cwd=tmp_path) as running,
        ):
            talk_to_the_gate(program)
            finished = running.finish(TIMEOUT_S)
    assert finished.exit_code == 0, finished.output
    assert "gate ended the project: told to by a service" in finished.output
    counters = finished.connection("gate.passed -> book.passed")
    written = (finished.run_folder / "book/book").read_text().split()
    assert counters["sent"] == counters["received"] == counters["consumed"] == len(written) >= 1


def talk_to_the_gate(program: RosProgram, *, hears_connections: bool = True) -> None:
    """Ask, listen to what is answered and to what it sends its neighbour, and end it."""
    answered = program.listen("/answered", "std_msgs/msg/Int32")
    passed = [Int32(data=21)]
    if hears_connections:
        passed = program.listen("/neuros/gate/passed/book/passed/data", "std_msgs/msg/Int32")
    ask = program.node.create_publisher(Int32, "/asked", 10)

    def is_heard() -> bool:
        ask.publish(Int32(data=21))
        return bool(answered and passed)

    program.spin_until(is_heard)
    assert answered[0].data == 42
    assert passed[0].data == 21

    def has_ticked() -> bool:
        told = program.call(Trigger, "/gate/tell", Trigger.Request())
        assert int(told.message) >= 1
        return bool(told.success)  # whether its timer has run

    program.spin_until(has_ticked)
    # The service knows the client from here on, so that its last answer is not lost.
    assert not program.call(SetBool, "/gate/stop", SetBool.Request(data=False)).success
    assert program.call(SetBool, "/gate/stop", SetBool.Request(data=True)).success
