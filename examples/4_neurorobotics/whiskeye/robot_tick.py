"""WhiskEye in MuJoCo, STEP_SECONDS of physics every TICK_SECONDS of wall time."""

import os

from turning_robot import start_turning

from neuros.hooks import Optional, neuros_initialise, neuros_tick

STEP_SECONDS = float(os.environ.get("STEP_SECONDS", "0.02"))  # at most one IMU period


@neuros_initialise()
def start(node):
    node.expect_end(start_turning(node).duration_s)


@neuros_tick(
    seconds=float(os.environ.get("TICK_SECONDS", "0.02")),
    outputs=[Optional("imu"), Optional("pose")],
)
def simulate(node):
    robot = node.get_user_data()
    robot.turn()
    robot.sim.step_synchronous(round(STEP_SECONDS / robot.sim.timestep))
    if robot.is_done:
        robot.end(node)
    return robot.sim.read("imu"), robot.sim.read("pose")
