"""External topics on which a node hears nobody: said once, since nothing else would tell.

Connections between nodes are proved by their registration. An external topic has no other end that
could confirm, and a node that has other work to do never stalls for it.
"""

from __future__ import annotations

from collections.abc import Mapping

from rclpy.node import Node as RosNode
from rclpy.subscription import Subscription

from neuros.project.model import Port
from neuros.transport.mismatches import differences
from neuros.transport.ros_loop import RosLoop

LOOK_AFTER_S = 5.0
"""By then, programs that are there have been found."""


def warn_of_silence(ros_node: RosNode, heard: Mapping[Port, Subscription], loop: RosLoop) -> None:
    """Warn in the node's log of external inputs that nobody serves, :data:`LOOK_AFTER_S` from now.

    What is silent since the QoS does not fit has been said already.

    Args:
        heard: the inputs with an external topic, and what listens there.
    """

    def look() -> None:
        ros_node.destroy_timer(timer)
        for port, subscription in heard.items():
            if subscription.get_publisher_count():
                continue
            reason = _reason(ros_node, port, subscription)
            if reason:
                ros_node.get_logger().warning(f"input '{port.name}': {reason}")

    timer = loop.every(ros_node, LOOK_AFTER_S, look)


def _reason(ros_node: RosNode, port: Port, subscription: Subscription) -> str:
    topic = subscription.topic_name
    listed = ros_node.get_publishers_info_by_topic(port.external_topic)
    types = {each.topic_type for each in listed}
    if types - {port.type}:
        return f"{topic} is published as {' and '.join(sorted(types))}, not as {port.type}"
    if types:
        if all(any(differences(each.qos_profile, subscription.qos_profile)) for each in listed):
            return ""
        names = " and ".join(sorted({each.node_name for each in listed}))
        return f"{names} publishes on {topic}, but DDS has not connected the two"
    return (
        f"nobody publishes on {topic}, or nobody that can be seen from here: another ROS domain, "
        "network or machine, a container with a network of its own, DDS without UDP"
    )
