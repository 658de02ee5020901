"""A pendulum, at a fifth of real time."""

from neuros.hooks import neuros_initialise
from neuros.simulators.mujoco import MuJoCo


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, "pendulum.xml")
    sim.run_asynchronous(0.2)
    node.set_user_data(sim)
