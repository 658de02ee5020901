"""WhiskEye drives and turns in the room for DURATION s; its eyes see it at 10 Hz.

With EMPTY_BETWEEN_FRAMES=1 both eyes send a packet with every one of the IMU, without pixels where
no picture is due. So what follows can be in step with the IMU, packet by packet.
"""

import os

from wandering_robot import WanderingRobot

from neuros.hooks import Optional, neuros_function, neuros_initialise

EYES = ("left_eye", "right_eye")
SENSES = ("imu", "pose", *EYES, "body_camera")


@neuros_initialise()
def start(node):
    node.expect_end(duration_s())
    node.set_user_data(WanderingRobot(node))


# No input is required, so this is the node's main loop: see robot.py.
@neuros_function(outputs=[Optional(name) for name in SENSES])
def simulate(node):
    robot = node.get_user_data()
    robot.sim.step_to_next()
    robot.steer()
    if robot.sim.sim_time > duration_s() - robot.sim.timestep / 2:
        # A network that has begun to learn is waited for.
        node.shutdown(f"{duration_s():g} s simulated", drain_s=60.0)
    readings = {name: robot.sim.read(name) for name in SENSES}
    if readings["imu"] is not None and os.environ.get("EMPTY_BETWEEN_FRAMES", "0") != "0":
        for eye in EYES:
            if readings[eye] is None:
                readings[eye] = node.make_packet(eye)
                readings[eye].header = readings["imu"].header
    return tuple(readings.values())


def duration_s():
    """Simulated seconds until the end."""
    return float(os.environ.get("DURATION", "60"))
