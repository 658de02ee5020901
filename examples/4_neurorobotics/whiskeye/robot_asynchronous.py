"""WhiskEye in MuJoCo, running by itself; its sensors' packets leave without a hook.

REAL_TIME_FACTOR is how fast simulated time passes, or "max" for as fast as possible.
"""

import os

from turning_robot import start_turning

from neuros.hooks import neuros_initialise, neuros_tick


@neuros_initialise()
def start(node):
    factor = os.environ.get("REAL_TIME_FACTOR", "1.0")
    robot = start_turning(node)
    node.expect_end(robot.duration_s)
    robot.sim.run_asynchronous(None if factor == "max" else float(factor))


@neuros_tick(seconds=0.01)
def watch_the_time(node):
    robot = node.get_user_data()
    robot.turn()
    if robot.is_done:
        robot.end(node)
