"""An elevator that runs by itself; its readings leave without a hook.

REAL_TIME_FACTOR is how fast simulated time passes, or "max" for as fast as possible.
"""

import os

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

FACTOR = os.environ["REAL_TIME_FACTOR"]


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, "elevator.xml")
    sim.run_asynchronous(None if FACTOR == "max" else float(FACTOR))
    node.set_user_data(sim)


@neuros_function(inputs="target")
def obey(node, target):
    node.get_user_data().command("target", target)
