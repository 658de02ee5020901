"""A simulator that serves the standard; its own thread steps it, or with HOOK=1 a hook."""

import os

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo
from neuros.simulators.standard import serve


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, "world.xml")
    serve(node, sim, "box_world")
    sim.pause()
    if os.environ["HOOK"] == "0":
        sim.run_asynchronous(None)
    node.set_user_data(sim)


if os.environ["HOOK"] == "1":

    @neuros_function(outputs=["imu", "clock"])
    def step(node):
        sim = node.get_user_data()
        sim.step_to_next()
        return sim.read("imu"), sim.read("clock")

else:

    @neuros_function(inputs="stop")
    def stop(node, stop):
        node.shutdown("told to stop")
