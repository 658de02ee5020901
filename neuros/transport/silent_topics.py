"""External topics on which a node hears nobody: said once, since nothing else would tell.

Connections between nodes are proved by their registration. An external topic has no other end that
could confirm, and a node that has other work to do never stalls for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rclpy.node import Node as RosNode
from rclpy.subscription import Subscription

from neuros.project.model import Port

LOOK_AFTER_S = 5.0
"""By then, programs that are there have been found."""


def warn_of_silence(
    ros_node: RosNode,
    heard: Mapping[Port, Subscription],
    guard: Callable[[Callable[[], None]], None],
) -> None:
    """Warn in the node's log of external inputs that nobody serves, :data:`LOOK_AFTER_S` from now.

    Args:
        heard: the inputs with an external topic, and what listens there.
        guard: runs a callback of ROS.
    """

    def look() -> None:
        ros_node.destroy_timer(timer)
        for port, subscription in heard.items():
            if not subscription.get_publisher_count():
                ros_node.get_logger().warning(f"input '{port.name}': {_reason(ros_node, port)}")

    timer = ros_node.create_timer(LOOK_AFTER_S, lambda: guard(look))


def _reason(ros_node: RosNode, port: Port) -> str:
    topic = str(port.external_topic)
    listed = ros_node.get_publishers_info_by_topic(topic)
    types = {each.topic_type for each in listed}
    if types - {port.type}:
        return f"{topic} is published as {' and '.join(sorted(types))}, not as {port.type}"
    if types:
        names = " and ".join(sorted({each.node_name for each in listed}))
        return f"{names} publishes on {topic}, but DDS has not connected the two"
    return (
        f"nobody publishes on {topic}, or nobody that can be seen from here: another ROS domain, "
        "network or machine, a container with a network of its own, DDS without UDP"
    )
