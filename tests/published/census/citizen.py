from neuros.hooks import neuros_function


@neuros_function(inputs="start")
def answer(node, _):
    node.get_ros_node().get_logger().info("counted")
