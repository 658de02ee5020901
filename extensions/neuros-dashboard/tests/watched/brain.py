"""Takes 5 ms per reading, as a network would, and says so now and then."""

import time

from neuros.hooks import neuros_function

WORK_S = 0.005


@neuros_function(inputs="imu", outputs="command")
def think(node, imu):
    time.sleep(WORK_S)
    if abs(imu.angular_velocity.z) > 0.99:
        node.get_logger().warning(f"turning fast: {imu.angular_velocity.z:.3f}")
    else:
        node.get_logger().info("turning")
    command = node.make_packet("command")
    command.data = -imu.angular_velocity.z
    return command


@neuros_function(inputs="image")
def see(node, image):
    pass


@neuros_function(inputs="clock")
def note(node, clock):
    pass
