"""A vehicle on two wheels, after Braitenberg: each spike of a motor neuron pushes one wheel."""

import math
import os
from array import array

from neuros.hooks import neuros_function, neuros_initialise

STEP_S = 0.02
LIGHT = (2.0, 0.0)
NEAR_M = 0.25
LONGEST_S = 60.0


class Vehicle:
    def __init__(self, heading_rad):
        self.x = self.y = self.time_s = 0.0
        self.heading_rad = heading_rad
        self.wheels = [0.0, 0.0]  # m/s, left and right

    @property
    def distance_m(self):
        return math.hypot(LIGHT[0] - self.x, LIGHT[1] - self.y)

    def light(self):
        """How much each eye sees, 0 to 1: one looks 45 degrees to the left, one to the right."""
        angle = math.atan2(LIGHT[1] - self.y, LIGHT[0] - self.x) - self.heading_rad
        return [(1 + math.cos(angle - eye)) / 2 for eye in (math.pi / 4, -math.pi / 4)]

    def move(self, spikes):
        """The wheels keep some of their speed, and each spike adds to it."""
        self.wheels = [0.9 * v + 0.1 * s for v, s in zip(self.wheels, spikes, strict=True)]
        left, right = self.wheels
        speed, turn = 0.5 * (left + right) / 2, 2.0 * (right - left)
        self.heading_rad += turn * STEP_S
        self.x += speed * math.cos(self.heading_rad) * STEP_S
        self.y += speed * math.sin(self.heading_rad) * STEP_S
        self.time_s += STEP_S


def seen(node, vehicle):
    packet = node.make_packet("light")
    packet.data = array("f", vehicle.light())
    return packet


@neuros_initialise(outputs="light")
def start(node):
    vehicle = Vehicle(math.radians(float(os.environ["HEADING"])))
    node.set_user_data(vehicle)
    return seen(node, vehicle)


@neuros_function(inputs="spikes", outputs="light")
def drive(node, spikes):
    vehicle = node.get_user_data()
    vehicle.move(spikes.data)
    if vehicle.distance_m < NEAR_M or vehicle.time_s > LONGEST_S:
        node.set_result("distance_m", vehicle.distance_m)
        text = f"{vehicle.distance_m:.2f} m from the light after {vehicle.time_s:.2f} s"
        node.get_logger().info(text)
        node.shutdown(text)
    return seen(node, vehicle)
