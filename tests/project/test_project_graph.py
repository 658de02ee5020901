"""The project as a picture in text."""

from __future__ import annotations

from pathlib import Path

from neuros.project.graph import graph_mermaid, graph_text
from neuros.project.model import Connection, Node, Port, Project

IMU, FLOAT = "sensor_msgs/msg/Imu", "std_msgs/msg/Float64"
PROJECT = Project(
    "demo",
    (
        Node(
            "robot", "neuros_mujoco", Path("/demo/robot.py"),
            inputs=(Port("cmd", FLOAT, external_topic="/cmd"),),
            outputs=(Port("imu", IMU), Port("pose", FLOAT), Port("unused", FLOAT)),
        ),
        Node("snn", "neuros_nest", Path("/demo/snn.py"), inputs=(Port("imu", IMU),)),
        Node(
            "end", "neuros_python", Path("/demo/plot.py"),
            inputs=(Port("truth", FLOAT), Port("other", FLOAT)),
        ),
    ),
    (
        Connection("robot", "imu", "snn", "imu", discard_limit=0, queue_size=8, compression="zstd"),
        Connection("robot", "pose", "end", "truth"),
        Connection("robot", "pose", "end", "other", discard_limit=5),
    ),
    Path("/demo/project.json"),
    "A robot turns",
)  # fmt: skip


def test_text() -> None:
    assert (
        graph_text(PROJECT)
        == """\
demo: 3 nodes, 3 connections
A robot turns

robot  (neuros_mujoco, robot.py)
  in  cmd     std_msgs/msg/Float64
      <- topic /cmd
  out imu     sensor_msgs/msg/Imu
      -> snn.imu   lossless, zstd, queue 8
  out pose    std_msgs/msg/Float64
      -> end.truth   best effort
      -> end.other   discards <= 5
  out unused  std_msgs/msg/Float64
      not connected

snn  (neuros_nest, snn.py)
  in  imu  sensor_msgs/msg/Imu
      <- robot.imu

end  (neuros_python, plot.py)
  in  truth  std_msgs/msg/Float64
      <- robot.pose
  in  other  std_msgs/msg/Float64
      <- robot.pose
"""
    )


def test_mermaid() -> None:
    assert (
        graph_mermaid(PROJECT)
        == """\
flowchart LR
    n0["robot<br/>neuros_mujoco"]
    n1["snn<br/>neuros_nest"]
    n2["end<br/>neuros_python"]
    n0 ==>|"imu<br/>lossless, zstd, queue 8"| n1
    n0 -.->|"pose → truth<br/>best effort"| n2
    n0 -->|"pose → other<br/>discards <= 5"| n2
    t0(["/cmd"])
    t0 -.->|"cmd"| n0
"""
    )
