from neuros.hooks import neuros_initialise, neuros_function, All


@neuros_initialise(outputs="election")
def call_election(node):
    node.get_ros_node().get_logger().info("the polls are open")
    return node.make_packet("election")


@neuros_function(inputs=All("ballot"), outputs="election")
def count(node, ballots):
    votes = sorted(ballot.data for ballot in ballots)
    node.get_ros_node().get_logger().info(f"counted {votes}")
    return node.make_packet("election")
