"""Has a timer of ROS every 10 ms of simulated time."""

import itertools

from neuros.hooks import neuros_initialise, neuros_tick

TIMES = []


@neuros_initialise()
def begin(node):
    ros = node.get_ros_node()
    ros.create_timer(0.01, lambda: TIMES.append(ros.get_clock().now().nanoseconds))


@neuros_tick(seconds=0.02)
def look(node):
    if len(TIMES) == 10:
        gaps = [round((b - a) / 1e6) for a, b in itertools.pairwise(TIMES)]
        node.get_logger().info(f"gaps in ms: {sorted(gaps)}")
        TIMES.append(0)
