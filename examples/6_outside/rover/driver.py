"""Drives the rover, as a plain ROS 2 program, and prints where it is and how it fares."""

import rclpy
from geometry_msgs.msg import Point, Twist
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String


class Driver(Node):
    """Tells the rover to go forward, faster than it can."""

    def __init__(self):
        super().__init__("driver")
        self.position = Point()
        self.publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Point, "position", self.on_position, 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(String, "state", self.on_state, latched)
        self.create_timer(0.1, self.on_timer)

    def on_timer(self):
        command = Twist()
        command.linear.x = 1.0
        self.publisher.publish(command)

    def on_position(self, position):
        self.position = position

    def on_state(self, state):
        print(f"{self.position.x:.1f} m: {state.data}", flush=True)


if __name__ == "__main__":
    try:
        rclpy.init()
        rclpy.spin(Driver())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
