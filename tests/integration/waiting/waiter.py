"""Tries, in hooks, ways of waiting for a callback; a node of its own is spun in a thread."""

import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from neuros.errors import NodeError
from neuros.hooks import neuros_finalise, neuros_initialise


def try_all(node):
    ros = node.get_ros_node()
    client = ros.create_client(Trigger, "nobody")
    future = client.call_async(Trigger.Request())
    own = SingleThreadedExecutor(context=ros.context)
    for wait in (
        lambda: client.call(Trigger.Request()),
        lambda: ros.executor.spin_once(timeout_sec=0.1),
        lambda: rclpy.spin_once(ros, executor=own, timeout_sec=0.1),
        lambda: rclpy.spin_until_future_complete(ros, future, own),
    ):
        try:
            wait()
        except NodeError as error:
            node.get_logger().info(f"refused: {error}")
    own.shutdown()


def spin_a_node_of_ones_own(node):
    context = rclpy.Context()
    rclpy.init(context=context)
    own = rclpy.create_node("of_ones_own", context=context)
    executor = SingleThreadedExecutor(context=context)
    ticks = []
    own.create_timer(0.01, lambda: ticks.append("tick"))
    while not ticks:
        rclpy.spin_once(own, executor=executor)
    executor.shutdown()
    own.destroy_node()
    rclpy.shutdown(context=context)


@neuros_initialise()
def begin(node):
    try_all(node)
    thread = threading.Thread(target=spin_a_node_of_ones_own, args=(node,))
    thread.start()
    thread.join()
    node.shutdown("spun in a thread")


@neuros_finalise()
def end(node):
    rclpy.spin(node.get_ros_node())
