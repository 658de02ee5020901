"""The spiking network that integrates the gyroscope into a heading."""

import math
import os

from head_direction import HeadDirectionNetwork

from neuros.hooks import neuros_function, neuros_initialise
from neuros.time import to_nanoseconds

WINDOW_NS = 20_000_000


class GyroIntegrator:
    """Feeds the network with yaw rates, each for the time since the stamp before.

    By stamps and not per packet: a packet that was lost on the way would be lost angle otherwise.
    The network simulates one window per packet. What went by before that window, while it was busy,
    is bridged by the turn that the same gyroscope tells. If it were simulated, each packet
    would take longer than the one before it wherever the robot is the faster one.

    Without bridges, what went by is lost angle: then the error shows what losses cost the network.
    """

    def __init__(self, network, bias_rad_s=0.0, *, bridges=True):
        self.network = network
        self._bridges = bridges
        self._bias_rad_s = bias_rad_s
        self._quantum_ns = round(network.quantum_s * 1e9)
        self._done_ns = 0  # the network was settled for the start of simulated time
        self.bridged_rad = self.bridged_s = 0.0

    def integrate(self, stamp_ns, rate_rad_s):
        """Heading in radians at ``stamp_ns``, decoded over about the last 20 ms before."""
        rate_rad_s += self._bias_rad_s
        missed_ns = max(0, (stamp_ns - self._done_ns) // WINDOW_NS - 1) * WINDOW_NS
        self.bridged_s += missed_ns * 1e-9
        self.bridged_rad += rate_rad_s * missed_ns * 1e-9 * self._bridges
        self._done_ns += missed_ns
        quanta = (stamp_ns - self._done_ns) // self._quantum_ns  # the rest is for the next packet
        if quanta > 0:
            step_ns = quanta * self._quantum_ns
            self.network.step(rate_rad_s, step_ns * 1e-9)
            self._done_ns += step_ns
        return math.remainder(self.network.heading_rad + self.bridged_rad, math.tau)


@neuros_initialise()
def start(node):
    network = HeadDirectionNetwork(seed=int(os.environ.get("SEED", "1")))
    network.settle()
    bias_rad_s = float(os.environ.get("GYRO_BIAS", "0"))
    bridges = os.environ.get("BRIDGE", "1") != "0"
    node.set_user_data(GyroIntegrator(network, bias_rad_s, bridges=bridges))


@neuros_function(inputs="imu", outputs="estimate")
def integrate(node, imu):
    heading_rad = node.get_user_data().integrate(to_nanoseconds(imu), imu.angular_velocity.z)
    estimate = node.make_packet("estimate")
    estimate.header.stamp = imu.header.stamp
    estimate.header.frame_id = "world"
    estimate.vector.z = heading_rad
    return estimate
