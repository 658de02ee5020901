"""The spiking network as a brain: it senses with one message and commands with another."""

import math
import os

from head_direction import HeadDirectionNetwork
from snn import GyroIntegrator

from neuros.hooks import Optional, neuros_function, neuros_initialise
from neuros.time import to_nanoseconds

LOOK_AHEAD_RAD = math.pi / 2  # of the gimbal: the two cameras of the head look forward and up
RATE_RAD_S = float(os.environ.get("RATE", "1.0"))


@neuros_initialise()
def start(node):
    network = HeadDirectionNetwork(seed=int(os.environ.get("SEED", "1")))
    network.settle()
    bias_rad_s = float(os.environ.get("GYRO_BIAS", "0"))
    node.set_user_data(GyroIntegrator(network, bias_rad_s))


@neuros_function(inputs="senses", outputs=["commands", Optional("estimate")])
def think(node, senses):
    commands = node.make_packet("commands")
    commands.header = senses.header
    commands.rotations.names = ["pose_theta", "neck_gmbl"]
    commands.rotations.values = [RATE_RAD_S, LOOK_AHEAD_RAD]
    return commands, estimate(node, senses)


def estimate(node, senses):
    stamp_ns = to_nanoseconds(senses.imu)
    if stamp_ns == 0:  # the first message: the gyroscope has not fired yet
        return None
    packet = node.make_packet("estimate")
    packet.header.stamp = senses.imu.header.stamp
    packet.header.frame_id = "world"
    packet.vector.z = node.get_user_data().integrate(stamp_ns, senses.imu.angular_velocity.z)
    return packet
