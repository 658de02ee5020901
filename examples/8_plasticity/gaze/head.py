"""A head that is turned, and its eye, in MuJoCo. It waits for each command of the eye's muscle."""

import os

import numpy as np

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

STEPS = 10  # of 2 ms each, between two packets


@neuros_initialise(outputs=["turn", "slip"])
def start(node):
    simulator = MuJoCo(node, "head.xml")
    node.set_user_data(simulator)
    simulator.step_synchronous(STEPS)
    return felt(simulator.data)


@neuros_function(inputs=["chair", "muscle"], outputs=["turn", "slip"])
def move(node, chair, muscle):
    simulator = node.get_user_data()
    simulator.command("chair", chair)
    simulator.command("muscle", muscle)
    simulator.step_synchronous(STEPS)
    return felt(simulator.data)


def felt(data):
    """How fast the head turns, and how fast the picture slips on the retina, both in rad/s.

    Glasses that magnify make the world turn faster: GLASSES times as fast as the head.
    """
    head, gaze = data.sensor("head").data[2], data.sensor("gaze").data[2]
    eye = gaze - head
    return np.array([head]), np.array([float(os.environ["GLASSES"]) * head + eye])
