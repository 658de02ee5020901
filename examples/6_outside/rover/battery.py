"""A battery, as a plain ROS 2 program: it knows nothing of NeuROS."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState
from std_srvs.srv import Trigger


class Battery(Node):
    """Loses a fifth of its charge per second, and can be charged."""

    def __init__(self):
        super().__init__("battery")
        self.charge = 1.0
        self.publisher = self.create_publisher(BatteryState, "battery", qos_profile_sensor_data)
        self.create_service(Trigger, "charge", self.on_charge)
        self.create_timer(0.1, self.on_timer)

    def on_timer(self):
        self.charge = max(0.0, self.charge - 0.02)
        self.publisher.publish(BatteryState(percentage=self.charge))

    def on_charge(self, request, response):
        self.charge = 1.0
        response.success, response.message = True, "full again"
        return response


if __name__ == "__main__":
    try:
        rclpy.init()
        rclpy.spin(Battery())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
