"""A plain ROS program that is there from the start: publishers of all kinds, and a service."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


def greet(request, response):
    response.success, response.message = True, "hello"
    return response


try:
    rclpy.init()
    node = rclpy.create_node("program")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_publisher(Int32, "/latched", latched).publish(Int32(data=1))
    publishers = [
        node.create_publisher(Int32, "/fast", qos_profile_sensor_data),
        node.create_publisher(Int32, "/sure", 10),
        node.create_publisher(Int32, "/strict", qos_profile_sensor_data),
    ]
    node.create_subscription(Int32, "/loose", lambda _: print("heard", flush=True), 10)
    node.create_service(Trigger, "/greet", greet)
    node.create_timer(0.05, lambda: [each.publish(Int32(data=1)) for each in publishers])
    print("here", flush=True)
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
