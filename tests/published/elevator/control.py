from neuros.hooks import neuros_initialise, neuros_function

LEVELS = [2, 0, 1]


def next_command(node):
    command = node.make_packet("command")
    command.data = LEVELS[node.get_user_data() % len(LEVELS)]
    node.set_user_data(node.get_user_data() + 1)
    return command


@neuros_initialise(outputs="command")
def initialise(node):
    node.set_user_data(0)
    return next_command(node)


@neuros_function(inputs="sensor_data", outputs="command")
def handle_sensor_data(node, sensor_data):
    node.get_ros_node().get_logger().info(f"at level {sensor_data.data}")
    return next_command(node)
