"""WhiskEye in MuJoCo: does what its brain says, and tells it all that it senses, in lockstep."""

import os

import mujoco
from turning_robot import TurningRobot

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

PARTS = ("imu", "left_camera", "right_camera", "body_camera")
"""Sensors of the node file that go into the message, as fields of these names."""


@neuros_initialise(outputs="senses")
def start(node):
    sim = MuJoCo(node, "whiskeye.xml")
    node.set_user_data(TurningRobot(sim, float(os.environ.get("DURATION", "20"))))
    return senses(node, sim)  # before any sensor has fired: joints only


@neuros_function(inputs="commands", outputs=["senses", "pose"])
def act(node, commands):
    robot = node.get_user_data()
    for told in (commands.positions, commands.rotations):
        for joint, value in zip(told.names, told.values, strict=True):
            robot.sim.actuate(joint, value)
    robot.sim.step_to_next()
    if robot.is_done:
        robot.end(node)
    return senses(node, robot.sim), robot.sim.read("pose")


def senses(node, sim):
    message = node.make_packet("senses")
    message.header.stamp = node.now()
    message.header.frame_id = "body"
    for index in range(sim.model.njnt):
        is_slide = sim.model.jnt_type[index] == mujoco.mjtJoint.mjJNT_SLIDE
        joints = message.positions if is_slide else message.rotations
        joints.names.append(sim.model.joint(index).name)
        joints.values.append(sim.data.qpos[sim.model.jnt_qposadr[index]])
    for part in PARTS:
        reading = sim.read(part)
        if reading is not None:
            setattr(message, part, reading)
    return message
