"""WhiskEye in MuJoCo, one sensor firing after the other, as fast as its outputs let it."""

from turning_robot import start_turning

from neuros.hooks import Optional, neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    node.expect_end(start_turning(node).duration_s)


# No input is required, so this is the node's main loop: it runs again and again, and waits while
# a connection of one of its outputs is blocked.
@neuros_function(outputs=[Optional("imu"), Optional("pose")])
def simulate(node):
    robot = node.get_user_data()
    robot.turn()
    robot.sim.step_to_next()
    if robot.is_done:
        robot.end(node)
    return robot.sim.read("imu"), robot.sim.read("pose")
