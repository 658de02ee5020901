"""The robot: turns at the rate that the brain asks for, and tells its heading."""

from neuros.hooks import Optional, neuros_function, neuros_initialise

STEP_S = 0.02
STEPS = 250


class Robot:
    heading_rad = 2.0
    step = 0


@neuros_initialise(outputs="heading")
def begin(node):
    node.set_user_data(Robot())
    return heading_of(node)


@neuros_function(inputs="turn", outputs=Optional("heading"))
def move(node, turn):
    robot = node.get_user_data()
    robot.heading_rad += turn.data * STEP_S
    robot.step += 1
    if robot.step % 50 == 0:
        node.get_logger().info(
            f"after {robot.step * STEP_S:.1f} s the heading is {robot.heading_rad:.4f} rad"
        )
    if robot.step == STEPS:
        node.set_result("heading_rad", robot.heading_rad)
        return node.shutdown(f"{STEPS * STEP_S:g} s of the robot's time are over")
    return heading_of(node)


def heading_of(node):
    packet = node.make_packet("heading")
    packet.data = node.get_user_data().heading_rad
    return packet
