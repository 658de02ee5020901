"""Drives by touch, and turns back to a heading that it remembers, by what the ring estimates."""

import os

from homing import Homing, Phase

from neuros.hooks import Optional, neuros_function, neuros_initialise
from neuros.snn import derive_seed
from neuros.time import to_seconds

PERIOD_S = 0.02


@neuros_initialise(outputs="command")
def start(node):
    seed = derive_seed(int(os.environ.get("SEED", "1")), node.name)
    walls, speed_m_s = int(os.environ.get("WALLS", "2")), float(os.environ.get("SPEED", "0.4"))
    node.set_user_data(Homing(walls, speed_m_s, seed))
    return node.make_packet("command")  # stand: the robot waits for the first one


@neuros_function(
    inputs=["estimate", "touch"], outputs=[Optional("command"), Optional("remembered")]
)
def act(node, estimate, touch):
    homing = node.get_user_data()
    before = homing.phase
    ahead_m_s, yaw_rad_s = homing.step(estimate.vector.z, touch.data, PERIOD_S)
    if homing.phase is not before:
        node.get_logger().info(f"{homing.phase.value}, {to_seconds(estimate):.2f} s")
    if homing.phase is Phase.DONE:
        node.set_result("walls_met", homing.walls_met)
        node.shutdown("stood at the remembered heading")
        return None, None
    command = node.make_packet("command")
    command.linear.x, command.angular.z = ahead_m_s, yaw_rad_s
    return command, remembered(node, homing, estimate, before)


def remembered(node, homing, estimate, before):
    """The packet, at the moment at which there is something to remember."""
    if (before, homing.phase) != (Phase.REMEMBER, Phase.DRIVE):
        return None
    packet = node.make_packet("remembered")
    packet.header = estimate.header
    packet.vector.z = homing.remembered_rad
    return packet
