import os

from neuros.hooks import neuros_function, Optional

GOAL = float(os.environ["GOAL"])


@neuros_function(inputs="temperature", outputs=Optional("heating"))
def decide(node, temperature):
    wanted = 1.0 if temperature.data < GOAL else 0.0
    if wanted == node.get_user_data():
        return None
    node.set_user_data(wanted)
    node.get_ros_node().get_logger().info("on" if wanted else "off")
    heating = node.make_packet("heating")
    heating.data = wanted
    return heating
