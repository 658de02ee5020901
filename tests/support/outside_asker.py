"""A plain ROS program that asks a node on external topics, for tests of who hears whom."""

from __future__ import annotations

PROGRAM = """
import sys, time
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("asker")
publisher = node.create_publisher(String, "/question", 10)
heard = []
node.create_subscription(String, "/answer", heard.append, 10)
mark, limit_s = sys.argv[1], float(sys.argv[2])
end = time.monotonic() + limit_s
while not any(each.data == f"{mark} heard" for each in heard):
    if time.monotonic() > end:
        sys.exit(f"no answer; {publisher.get_subscription_count()} listen")
    publisher.publish(String(data=mark))
    rclpy.spin_once(node, timeout_sec=0.05)
"""
"""Asks until it hears the answer to one of its questions; takes a mark of its own, and seconds."""
