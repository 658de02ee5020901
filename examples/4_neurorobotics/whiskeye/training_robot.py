"""WhiskEye drives and turns in the room, and sends with each view the pose that goes with it."""

from wandering_robot import WanderingRobot

from neuros.hooks import neuros_function, neuros_initialise

FIRST_WAY = 100  # no test takes the way of a training, with any seed below 100


@neuros_initialise()
def start(node):
    node.set_user_data(WanderingRobot(node, FIRST_WAY))


# All three sensors have one rate, so they fire together. The trainer ends the project.
@neuros_function(outputs=["left_eye", "right_eye", "label"])
def show(node):
    robot = node.get_user_data()
    robot.sim.step_to_next()
    robot.steer()
    return tuple(robot.sim.read(name) for name in ("left_eye", "right_eye", "label"))
