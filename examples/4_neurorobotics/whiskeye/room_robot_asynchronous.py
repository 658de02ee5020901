"""WhiskEye drives and turns in the room, running by itself; packets leave without a hook.

REAL_TIME_FACTOR is how fast simulated time passes, or "max" for as fast as possible.
"""

import os

from room_robot import duration_s
from wandering_robot import WanderingRobot

from neuros.hooks import neuros_initialise, neuros_tick


@neuros_initialise()
def start(node):
    factor = os.environ.get("REAL_TIME_FACTOR", "1.0")
    robot = WanderingRobot(node)
    node.set_user_data(robot)
    node.expect_end(duration_s())
    robot.sim.run_asynchronous(None if factor == "max" else float(factor))


@neuros_tick(seconds=0.02)
def steer(node):
    robot = node.get_user_data()
    with robot.sim.paused():
        robot.steer()
    if robot.sim.sim_time > duration_s() - robot.sim.timestep / 2:
        node.shutdown(f"{duration_s():g} s simulated")
