"""Says what it received."""

import sys

from neuros.hooks import neuros_function


@neuros_function(inputs="joints")
def receive(node, joints):
    version = ".".join(map(str, sys.version_info[:2]))
    node.get_logger().info(
        f"{list(joints.angles)} {joints.limits[1].upper} {joints.names} on Python {version}"
    )
