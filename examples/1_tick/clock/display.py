"""Shows the time that it is told."""

from neuros.hooks import neuros_function


@neuros_function(inputs="time")
def show(node, packet):
    node.get_logger().info(f"It is {packet.data}")
