"""A vehicle with two wheels and two eyes, in MuJoCo. It waits for each command of its wheels."""

import math

import numpy as np

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

STEPS = 10  # of 2 ms each, between two packets


@neuros_initialise(outputs=["eyes", "pose"])
def start(node):
    simulator = MuJoCo(node, "vehicle.xml")
    node.set_user_data(simulator)
    simulator.step_synchronous(STEPS)
    return seen(simulator.data), pose(simulator.data)


@neuros_function(inputs=["wheels", "lamp"], outputs=["eyes", "pose"])
def move(node, wheels, lamp):
    simulator = node.get_user_data()
    simulator.data.mocap_pos[0, :2] = lamp
    simulator.command("wheels", wheels)
    simulator.step_synchronous(STEPS)
    return seen(simulator.data), pose(simulator.data)


def seen(data):
    """What the left and the right eye see, 0 to 1: the cosine of the angle to the lamp, squared."""
    cosines = np.zeros(2)
    for number, eye in enumerate((data.site("left_eye"), data.site("right_eye"))):
        way = data.mocap_pos[0] - eye.xpos
        cosines[number] = eye.xmat[0::3] @ way / np.linalg.norm(way)
    return np.clip(cosines, 0.0, 1.0) ** 2


def pose(data):
    """Where the vehicle is, x and y (m), and where it looks (rad)."""
    body = data.body("vehicle")
    return np.array([*body.xpos[:2], math.atan2(body.xmat[3], body.xmat[0])])
