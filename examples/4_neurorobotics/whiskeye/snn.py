"""The spiking network that integrates the gyroscope into a heading."""

import os

from head_direction import HeadDirectionNetwork

from neuros.hooks import neuros_function, neuros_initialise

WINDOW_NS = 20_000_000


class GyroIntegrator:
    """Feeds the network with yaw rates, each for the time since the stamp before.

    By stamps and not per packet: a packet that was lost on the way would be lost angle otherwise.
    """

    def __init__(self, network, bias_rad_s=0.0):
        self._network = network
        self._bias_rad_s = bias_rad_s
        self._quantum_ns = round(network.quantum_s * 1e9)
        self._done_ns = 0  # the network's clock: it was settled for the start of simulated time

    def integrate(self, stamp_ns, rate_rad_s):
        """Heading in radians at ``stamp_ns``, decoded over about the last 20 ms before."""
        while (remaining_ns := stamp_ns - self._done_ns) >= self._quantum_ns:
            # Less than a quantum stays for the next packet; less than a window joins the last one.
            step_ns = WINDOW_NS
            if remaining_ns < 2 * WINDOW_NS:
                step_ns = remaining_ns - remaining_ns % self._quantum_ns
            self._network.step(rate_rad_s + self._bias_rad_s, step_ns * 1e-9)
            self._done_ns += step_ns
        return self._network.heading_rad


@neuros_initialise()
def start(node):
    network = HeadDirectionNetwork(seed=int(os.environ.get("SEED", "1")))
    network.settle()
    bias_rad_s = float(os.environ.get("GYRO_BIAS", "0"))
    node.set_user_data(GyroIntegrator(network, bias_rad_s))


@neuros_function(inputs="imu", outputs="estimate")
def integrate(node, imu):
    stamp = imu.header.stamp
    heading_rad = node.get_user_data().integrate(
        stamp.sec * 1_000_000_000 + stamp.nanosec, imu.angular_velocity.z
    )
    estimate = node.make_packet("estimate")
    estimate.header.stamp = stamp
    estimate.header.frame_id = "world"
    estimate.vector.z = heading_rad
    return estimate
