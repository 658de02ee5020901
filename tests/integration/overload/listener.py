"""Hears an external topic that is too fast, and has a timer and a subscription of its own."""

from notes import take
from std_msgs.msg import Int64MultiArray

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    ros = node.get_ros_node()
    ros.create_timer(0.25, lambda: take(node, "timer", None))
    ros.create_subscription(
        Int64MultiArray, "/overload", lambda packet: take(node, "callback", packet, 0.03), 1
    )


@neuros_function(inputs="outside")
def hear(node, packet):
    take(node, "hear", packet, 0.1)
