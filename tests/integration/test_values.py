"""Values of packets on real back ends: converted to the same bits everywhere, or refused."""

from __future__ import annotations

import itertools
import re
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy
import pytest
from hypothesis import HealthCheck, given, settings
from launching import BACKENDS, Finished, launch
from message_packages import write_package
from message_values import is_empty, parts, right_messages, wrong_messages
from needs import COMPILER
from rclpy.serialization import deserialize_message, serialize_message

import neuros.bag
from containers import require_containers
from neuros.cli.main import main
from neuros.errors import WrongValue
from neuros.project.model import Node, Port
from neuros.testing.harness import provide_messages, workspaces_of
from neuros.transport.codecs import message_codec
from neuros.transport.messages import copy_packet, message_class
from neuros.transport.values import checker

PROJECT = Path(__file__).parent / "values"
TWIST = (
    "linear=geometry_msgs.msg.Vector3(x=1.0, y=0.5, z=0.0),"
    " angular=geometry_msgs.msg.Vector3(x=0.0, y=0.0, z=2.5)"
)
ARRIVES = {
    "book/twist": f"geometry_msgs.msg.Twist({TWIST})",
    "book/flag": "std_msgs.msg.Bool(data=True)",
    "book/colour": f"std_msgs.msg.ColorRGBA(r={float(numpy.float32(0.1))}, g=0.0, b=0.0, a=1.0)",
    "book/count": "std_msgs.msg.UInt8(data=44)",
    "book/said": "std_msgs.msg.Float64(data=0.25)",
    "source/own": f"std_msgs.msg.Float32(data={float(numpy.float32(1 / 3))})",
}

Run = Callable[..., Finished]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs the project on a back end, once."""

    @cache
    def run_once(back_end: str, wrong: str = "") -> Finished:
        folder = tmp_path_factory.mktemp(f"{back_end}-{wrong}")
        arguments = ["-r", *(["--digests"] if back_end == "in-process" else [])]
        arguments += ["--set", f"nodes.source.environment.WRONG={wrong}"] if wrong else []
        return launch(PROJECT, "--backend", back_end, *arguments, cwd=folder, timeout_s=60)

    return run_once


@pytest.fixture(params=[*BACKENDS, "docker"])
def back_end(request: pytest.FixtureRequest) -> str:
    return available(request.param)


def available(back_end: str) -> str:
    if back_end == "docker":
        require_containers()
    return back_end


class TestWhatFits:
    @pytest.fixture
    def finished(self, back_end: str, run: Run) -> Finished:
        finished = run(back_end)
        assert finished.exit_code == 0, finished.output
        return finished

    def test_it_arrives_as_its_definition_says(self, finished: Finished) -> None:
        assert finished.run_folder is not None
        found = {name: (finished.run_folder / name).read_text() for name in ARRIVES}
        assert found == ARRIVES
        poses = (finished.run_folder / "book/poses").read_text()
        assert poses.count("geometry_msgs.msg.Pose(") == 4
        assert "x=0.0, y=7.0, z=0.0" in poses
        levels = (finished.run_folder / "book/levels").read_text()
        assert f"data=[1.0, {float(numpy.float32(0.1))}, inf]" in levels
        odometry = (finished.run_folder / "book/odometry").read_text()
        ones = [float(row == column) for row in range(6) for column in range(6)]
        ones[7] = 0.5
        numbers = re.findall(r"covariance=array\(\[([^]]*)\]\)", odometry)
        assert [float(number) for number in numbers[0].split(",")] == ones

    def test_it_is_recorded_as_it_arrives(self, finished: Finished) -> None:
        assert finished.run_folder is not None
        with neuros.bag.open(finished.run_folder) as bag:
            recorded = {name: bag[f"source.{name}"].array()[0] for name in ("twist", "flag", "own")}
            said = bag["/said"].array()["data"]
        assert recorded["twist"]["linear.x"] == 1.0
        assert recorded["twist"]["linear.y"] == 0.5
        assert recorded["flag"]["data"]
        assert recorded["own"]["data"] == numpy.float32(1 / 3)
        assert set(said) == {0.25}

    def test_it_has_the_digests_that_it_has_between_processes(
        self, back_end: str, finished: Finished, run: Run, capsys: pytest.CaptureFixture[str]
    ) -> None:
        digests = [
            {each["connection"]: each["digests"] for each in one.record["connections"]}
            for one in (finished, run("process"))
        ]
        assert digests[0] == digests[1]
        if back_end == "in-process":
            folders = (str(finished.run_folder), str(run("process").run_folder))
            assert main(["verify", *folders]) == 0, capsys.readouterr().out


# Every other kind of wrong value: tests/transport/test_packet_values.py.
REFUSED = {
    "nested": "packet for output 'poses': field 'poses[3].position.y' must be float64,"
    " but is 'up' (str)",
    "element": "WrongValue: field 'covariance' must be float64, but is None (NoneType)",
    "external": "packet for output 'said': field 'data' must be float64, but is 'loud' (str)",
}
RUNS = [
    *itertools.product(BACKENDS, REFUSED),
    *(("docker", wrong) for wrong in ("nested", "element")),
]


@pytest.mark.parametrize(("where", "wrong"), RUNS)
def test_what_does_not_fit_ends_the_run_with_its_place_and_nothing_is_sent(
    where: str, wrong: str, run: Run
) -> None:
    finished = run(available(where), wrong)
    assert finished.exit_code == 1, finished.output
    last = finished.output.splitlines()[-1]
    hook = "say" if wrong == "external" else "send"
    assert re.search(rf"/source\.py:\d+: hook '{hook}': ", last), last
    assert last.endswith(REFUSED[wrong])
    if hook == "send":
        assert {each["sent"] for each in finished.record["connections"]} == {0}
        assert finished.run_folder is not None
        assert not list((finished.run_folder / "book").glob("twist"))


EVERYTHING = """
bool[3] flags
bool[] any_flags
bool[<=2] few_flags
byte one
byte[2] bytes
byte[] any_bytes
char letter
char[] letters
string[2] names
string<=5 brief
string<=5[<=2] briefs
float32[2] floats
float32[<=3] few_floats
int64[<=3] few_integers
uint8[4] pixels
Limits[2] limits
Limits[<=2] few_limits
Limits[] any_limits
"""
ODD = "wstring wide\nwstring<=4 wide_brief\nwstring[] wides\nNothing nothing\n"
FILES = {
    "msg/Everything.msg": EVERYTHING,
    "msg/Odd.msg": ODD,
    "msg/Limits.msg": "float32 lower\nfloat64 upper 1.0\nstring<=3 name\n",
    "msg/Nothing.msg": "",
}


@pytest.fixture(scope="module")
def odd_messages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Any]]:
    """Message classes with fields that no package of ROS has."""
    folder = tmp_path_factory.mktemp("project")
    write_package(folder / "workspace", "value_msgs", FILES)
    node = Node(
        name="node",
        container="neuros_python",
        plugin=folder / "plugin.py",
        outputs=(Port("out", "value_msgs/msg/Everything"),),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        patch.setattr(sys, "path", sys.path[:])
        provide_messages(node, workspaces_of(folder, folder))
        yield [message_class(f"value_msgs/msg/{name}") for name in ("Everything", "Odd", "Nothing")]


@pytest.mark.needs(*COMPILER)
def test_fields_of_every_kind_arrive_alike_or_are_refused(odd_messages: list[Any]) -> None:
    for kind, each in itertools.product(odd_messages, (_arrives_alike, _is_refused)):
        each(kind)


def _arrives_alike(kind: Any) -> None:
    @settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
    @given(right_messages(kind))
    def check(messages: tuple[Any, Any]) -> None:
        packet, expected = checker(kind)(messages[0]), messages[1]
        codec = message_codec(kind)
        ways = (
            packet,
            copy_packet(packet),
            codec.decode(codec.encode(packet)),
            codec.decode(serialize_message(packet)),
            deserialize_message(codec.encode(packet), kind),
        )
        assert [parts(each) for each in ways] == [parts(expected)] * len(ways)

    check()


def _is_refused(kind: Any) -> None:
    if is_empty(kind):
        return

    @settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
    @given(wrong_messages(kind))
    def check(wrong: Any) -> None:
        with pytest.raises(WrongValue) as caught:
            checker(kind)(wrong.message)
        assert caught.value.path == wrong.path
        assert wrong.allowed in caught.value.allowed

    check()
