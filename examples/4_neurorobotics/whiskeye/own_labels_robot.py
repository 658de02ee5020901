"""WhiskEye drives and turns as in the training, and sends what its gyroscope measures, too."""

from training_robot import start

from neuros.hooks import Optional, neuros_function

__all__ = ["show", "start"]  # the hook that is imported is one of this node, too

SENSES = ("imu", "left_eye", "right_eye", "label")


# The trainer ends the project.
@neuros_function(outputs=[Optional(name) for name in SENSES])
def show(node):
    robot = node.get_user_data()
    robot.sim.step_to_next()
    robot.steer()
    return tuple(robot.sim.read(name) for name in SENSES)
