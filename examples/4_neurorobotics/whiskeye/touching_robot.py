"""WhiskEye in the room does as it is told, and feels with its whiskers: 20 ms per command."""

import math

from wandering_robot import LOOK_AHEAD_RAD, ROBOT

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, "room.xml")
    sim.actuate(f"{ROBOT}neck_gmbl", LOOK_AHEAD_RAD)
    node.set_user_data(sim)


# All three sensors have one rate, so they fire together.
@neuros_function(inputs="command", outputs=["imu", "pose", "touch"])
def act(node, command):
    sim = node.get_user_data()
    # The slides of the base are along the axes of the world, a command along those of the robot.
    heading_rad = float(sim.data.joint(f"{ROBOT}pose_theta").qpos[0])
    sim.actuate(f"{ROBOT}pose_x", command.linear.x * math.cos(heading_rad))
    sim.actuate(f"{ROBOT}pose_y", command.linear.x * math.sin(heading_rad))
    sim.actuate(f"{ROBOT}pose_theta", command.angular.z)
    sim.step_to_next()
    return sim.read("imu"), sim.read("pose"), sim.read("touch")
