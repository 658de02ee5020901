"""Sends numbers of all kinds, once; with WRONG, one that its field cannot hold."""

import os

import numpy as np
from geometry_msgs.msg import Pose

from neuros.hooks import neuros_function, neuros_initialise, neuros_tick

OUTPUTS = ("twist", "flag", "colour", "poses", "count", "own", "odometry", "levels")
WRONG = os.environ.get("WRONG", "")


@neuros_initialise(outputs=OUTPUTS)
def send(node):
    twist, flag, colour, poses, count, own, odometry, levels = map(node.make_packet, OUTPUTS)
    twist.linear.x = 1
    twist.linear.y = np.float32(0.5)
    twist.angular.z = np.array([2.5])
    flag.data = np.bool_(True)
    colour.r = 0.1
    colour.a = np.float64(1)
    poses.header.frame_id = np.str_("map")
    poses.poses = tuple(Pose() for _ in range(4))
    poses.poses[3].position.y = 7
    count.data = np.int64(44)
    own.data = 1 / 3
    odometry.pose.covariance = np.eye(6, dtype=int)
    odometry.pose.covariance[1, 1] = np.float32(0.5)
    levels.data = [1, 0.1, float("inf")]
    if WRONG == "nested":
        poses.poses[3].position.y = "up"
    elif WRONG == "element":
        odometry.pose.covariance[1, 1] = None
    return twist, flag, colour, poses, count, own, odometry, levels


@neuros_tick(seconds=0.05, outputs="said")
def say(node):
    said = node.make_packet("said")
    said.data = "loud" if WRONG == "external" else np.float32(0.25)
    return said


@neuros_function(inputs="own")
def take(node, own):
    (node.run_dir / "own").write_text(repr(own))
