"""The cart in MuJoCo. It waits for each command: so one seed gives one sequence of packets."""

import os

import numpy as np

from neuros.hooks import neuros_function, neuros_initialise, neuros_reset
from neuros.simulators.mujoco import MuJoCo


@neuros_initialise(outputs="joints")
def start(node):
    node.set_user_data(MuJoCo(node, "cart.xml"))
    return begin(node)


# In the place of the hook above when an environment is reset: the model stays loaded.
@neuros_reset(outputs="joints")
def begin(node):
    simulator = node.get_user_data()
    simulator.reset()
    random = np.random.default_rng(int(os.environ["SEED"]))
    simulator.data.qpos[:] = random.uniform(-0.05, 0.05, 2)
    simulator.step_to_next()
    return simulator.read("joints")


@neuros_function(inputs="force", outputs="joints")
def move(node, force):
    simulator = node.get_user_data()
    simulator.command("force", force)
    simulator.step_to_next()
    return simulator.read("joints")
