"""A plain ROS program that follows simulated time."""

import itertools

import rclpy
from rclpy.parameter import Parameter

rclpy.init()
follow = Parameter("use_sim_time", value=True)
node = rclpy.create_node("plain", parameter_overrides=[follow])
times = []
node.create_timer(0.01, lambda: times.append(node.get_clock().now().nanoseconds))
while len(times) < 10:
    rclpy.spin_once(node)
print(sorted(round((b - a) / 1e6) for a, b in itertools.pairwise(times)))
