"""``neuros replay --topic``: what a bag, a run folder or an option may not say."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from recordings import NUMBER, number, plan, record, spool

from neuros.cli.main import main
from neuros.errors import EnvironmentFault
from neuros.transport.messages import message_class
from neuros.transport.ros_topics import RosTopic, play


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run with a bag."""
    spool(tmp_path, "a", [(value, None, number(value)) for value in (1, 2, 3)])
    record(tmp_path, plan())
    return tmp_path


@pytest.mark.parametrize(
    "name",
    ["this/msg/Aaa", "this", "Float64", "/msg/Float64", "std_msgs/msg/__name__", "os/system"],
)
def test_what_names_no_message_type_is_not_imported(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with pytest.raises(EnvironmentFault, match=r"is not a message type|no message package named"):
        message_class(name)
    assert "this" not in sys.modules


def test_a_class_that_is_no_message_is_refused() -> None:
    with pytest.raises(EnvironmentFault, match="cannot be imported here"):
        message_class("std_msgs/msg/Metaclass_String")


@pytest.mark.parametrize(
    ("topic", "text"),
    [
        (RosTopic("/a b", NUMBER.type, True, 1), "topic '/a b' cannot be published"),
        (RosTopic("/a", NUMBER.type, True, 10**14, True), "/a cannot be published with depth"),
        (RosTopic("/a", NUMBER.type, True, -1), "/a cannot be published with depth -1"),
    ],
)
def test_a_topic_of_a_bag_that_ros_does_not_take_is_named(topic: RosTopic, text: str) -> None:
    with pytest.raises(EnvironmentFault, match=text):
        play([topic], [], rate=1.0, delay_s=0.0, subscriptions=0, domain_id=None)


@pytest.mark.parametrize(
    ("options", "environment", "text"),
    [
        (["--delay", "nan"], {}, "--delay must be"),
        (["--delay", "1e300"], {}, "--delay must be"),
        (["--rate", "1e-300"], {}, "--rate must be"),
        (["--rate", "inf"], {}, "--rate must be"),
        (["-w", "-1"], {}, "-w must be"),
        (["-d", "999"], {}, "'999' is not a ROS domain id"),
        (["-d", "-5"], {}, "'-5' is not a ROS domain id"),
        ([], {"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID: 'abc' is not a ROS domain id"),
        (["-n", "a", "--debugpy", "99999"], {}, "--debugpy must be a port"),
    ],
)
def test_a_wrong_option_is_said(
    run: Path,
    options: list[str],
    environment: dict[str, str],
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert main(["replay", str(run), "-t", "*", *options]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("content", ["[]", '{"messages": [5]}', '{"messages": 5}', "[" * 100_000])
def test_a_damaged_node_file_names_no_message_package(run: Path, content: str) -> None:
    (run / "a").mkdir(exist_ok=True)
    (run / "a" / "node.json").write_text(content)
    assert main(["replay", str(run), "-t", NUMBER.name, "--delay", "0"]) == 0


def test_a_pipe_in_place_of_a_node_file_does_not_hang(run: Path) -> None:
    (run / "a").mkdir(exist_ok=True)
    os.mkfifo(run / "a" / "node.json")
    assert main(["replay", str(run), "-t", NUMBER.name, "--delay", "0"]) == 0
