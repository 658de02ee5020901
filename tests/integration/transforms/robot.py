"""Tells where it is, ten times per second, and once where its camera is on it."""

from neuros.hooks import neuros_initialise, neuros_tick
from neuros.tf import transform


@neuros_initialise(outputs="mount")
def mount_camera(node):
    node.set_user_data({"x": 0.0})
    packet = node.make_packet("mount")
    packet.transforms = [transform("base", "camera", 0, (0.5, 0.0, 0.25))]
    return packet


@neuros_tick(seconds=0.1, outputs="pose")
def drive(node):
    memory = node.get_user_data()
    memory["x"] += 0.1
    now = node.get_ros_node().get_clock().now().to_msg()
    packet = node.make_packet("pose")
    packet.transforms = [transform("world", "base", now, (memory["x"], 0.0, 0.0))]
    return packet
