import math

from neuros.hooks import neuros_function


@neuros_function(inputs=["ground_truth", "heading"])
def compare(node, ground_truth, heading):
    turned = ground_truth.pose.orientation
    true = 2 * math.atan2(turned.z, turned.w)
    stamp = ground_truth.header.stamp
    if stamp.nanosec == 0:
        error = math.remainder(heading.data - true, 2 * math.pi)
        text = "close" if abs(error) < 0.1 else f"off by {error}"
        node.get_ros_node().get_logger().info(f"{stamp.sec} s: turned {heading.data:.1f}, {text}")
