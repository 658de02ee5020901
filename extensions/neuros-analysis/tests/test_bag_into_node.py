"""``neuros replay BAG --node --remap``: a bag of any program as the inputs of a node."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

import neuros.bag
from neuros.cli.main import main

STORE = get_typestore(Stores.ROS2_HUMBLE)
IMAGE, FLOAT = "sensor_msgs/msg/Image", "std_msgs/msg/Float64"
SECOND_NS = 1_000_000_000
BRAIN = """
from neuros.hooks import neuros_finalise, neuros_function, neuros_tick

@neuros_function(inputs="image", outputs="mean")
def see(node, image):
    mean = node.make_packet("mean")
    mean.data = sum(image.data) / len(image.data)
    node.get_logger().info(f"mean {mean.data}")
    return mean

@neuros_function(inputs="height")
def hear(node, height):
    node.get_logger().info(f"height {height.data}")
    if height.data == 9.0:
        node.shutdown("too high")

@neuros_tick(seconds=0.5, outputs="ticks")
def tick(node):
    return node.make_packet("ticks")

@neuros_finalise()
def end(node):
    node.get_logger().info("the end")
"""
PROJECT = {
    "nodes": [
        {
            "name": "robot",
            "container": "neuros_python",
            "plugin": "robot.py",
            "outputs": [{"name": "eye", "type": IMAGE}],
        },
        {
            "name": "brain",
            "container": "neuros_python",
            "plugin": "brain.py",
            "inputs": [
                {"name": "image", "type": IMAGE},
                {"name": "height", "type": FLOAT, "external_topic": "/height"},
            ],
            "outputs": [
                {"name": "mean", "type": FLOAT},
                {"name": "ticks", "type": "std_msgs/msg/Int32"},
            ],
        },
    ],
    "connections": [
        {
            "source_node": "robot",
            "source_output": "eye",
            "destination_node": "brain",
            "destination_input": "image",
            "discard_limit": 0,
        }
    ],
}


@pytest.fixture
def replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """The command in the folder of a project, with a bag of a camera and of a height."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "project.json").write_text(json.dumps(PROJECT))
    (tmp_path / "brain.py").write_text(BRAIN)
    (tmp_path / "robot.py").write_text("")
    write_bag(tmp_path / "bag", [0.5, 1.0, 1.5])
    return lambda *arguments: main(["replay", "bag", *arguments])


def write_bag(folder: Path, heights: list[float]) -> None:
    """A bag with a packet of each topic per second."""
    kinds = STORE.types
    with Writer(folder, version=8) as writer:
        camera = writer.add_connection("/camera/image", IMAGE, typestore=STORE)
        height = writer.add_connection("/h", FLOAT, typestore=STORE)
        for second, value in enumerate(heights, 1):
            stamp = kinds["builtin_interfaces/msg/Time"](second, 0)
            header = kinds["std_msgs/msg/Header"](stamp, "")
            pixels = np.full(2, second, np.uint8)
            image = kinds[IMAGE](header, 1, 2, "mono8", 0, 2, pixels)
            writer.write(camera, second * SECOND_NS, STORE.serialize_cdr(image, IMAGE))
            data = STORE.serialize_cdr(kinds[FLOAT](value), FLOAT)
            writer.write(height, second * SECOND_NS + 1, data)


TO_BRAIN = ("--node", "brain", "--remap", "/camera/image:=robot.eye")


def test_a_node_gets_the_packets_of_a_bag_in_their_order_and_time(
    replay: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(*TO_BRAIN, "--remap", "/h:=brain.height", "-o", "out") == 0
    assert capsys.readouterr().out.splitlines() == [
        "[INFO] [brain]: mean 1.0",
        "[INFO] [brain]: height 0.5",
        "[INFO] [brain]: mean 2.0",
        "[INFO] [brain]: height 1.0",
        "[INFO] [brain]: mean 3.0",
        "[INFO] [brain]: height 1.5",
        "[INFO] [brain]: the end",
        "/camera/image -> robot.eye: 3 packets",
        "/h -> brain.height: 3 packets",
        "starts of hooks: see 3, hear 3, tick 4",
        "brain.mean: 3 packets",
        "brain.ticks: 4 packets",
        f"{tmp_path}/out/bag",
    ]
    with neuros.bag.open("out/bag") as bag:
        mean = bag["/brain/mean"].array()
    assert mean["data"].tolist() == [1.0, 2.0, 3.0]
    assert mean["log_time_ns"].tolist() == [SECOND_NS, 2 * SECOND_NS, 3 * SECOND_NS]


def test_it_ends_where_the_node_ends_the_project(
    replay: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag(tmp_path / "high", [1.0, 9.0, 2.0])
    arguments = ["replay", "high", "--node", "brain", "--remap", "/h:=brain.height"]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "/h -> brain.height: 2 packets\n" in out
    assert out.endswith("'brain' ended the project: too high\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--remap", "/h:=brain.height"), "--remap needs the node that gets the packets: one"),
        (("--node", "brain", "--remap", "/h=brain.height"), "write TOPIC:=NODE.PORT, as /camera"),
        (("--node", "brain", "--remap", "/h:=height"), "write TOPIC:=NODE.PORT"),
        ((*TO_BRAIN, *TO_BRAIN[2:]), "/camera/image goes to robot.eye already"),
        ((*TO_BRAIN, "--pdb"), "--remap takes neither --pdb, --debugpy nor --topic"),
        ((*TO_BRAIN, "-p", "nowhere"), "there is no project nowhere: name it with --project"),
        (("--node", "brian", "--remap", "/h:=brian.height"), "has no node 'brian'"),
        (
            ("--node", "brain", "--remap", "/h:=brain.hight"),
            "'brain' has no such input or source; it has brain.image, brain.height, robot.eye\n",
        ),
        (
            ("--node", "brain", "--remap", "/nose:=brain.height"),
            "the bag has no topic /nose: there are /camera/image, /h\n",
        ),
        (
            ("--node", "brain", "--remap", "/h:=brain.image"),
            f"its packets are {FLOAT}, and those of 'image' {IMAGE}\n",
        ),
    ],
)
def test_a_rule_that_does_not_fit_is_named(
    replay: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    assert replay(*arguments) == 2
    assert said in capsys.readouterr().err


def test_all_wrong_rules_are_named_at_once(
    replay: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    rules = ("--remap", "/h:=brain.image", "--remap", "/nose:=brain.height")
    assert replay("--node", "brain", *rules) == 2
    err = capsys.readouterr().err
    assert "--remap /h:=brain.image: " in err
    assert "--remap /nose:=brain.height: " in err


def test_a_type_that_has_other_fields_here_is_named(
    replay: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file,) = (tmp_path / "bag").glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        change = "UPDATE message_definitions SET encoded_message_definition = 'float32[2] data'"
        database.execute(f"{change} WHERE topic_type = ?", [FLOAT])
    assert replay("--node", "brain", "--remap", "/h:=brain.height") == 2
    assert f"{FLOAT} has other fields in the bag than it has here" in capsys.readouterr().err
