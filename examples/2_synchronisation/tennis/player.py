"""One tennis player: hits back what comes, until the rally is long enough."""

import os

from neuros.hooks import Optional, neuros_function, neuros_initialise

RALLY = int(os.environ["RALLY"])


@neuros_initialise(outputs=Optional("ball_out"))
def serve(node):
    if os.environ["SERVES"] != "yes":
        return None
    ball = node.make_packet("ball_out")
    ball.data = 1
    node.get_ros_node().get_logger().info("I serve")
    return ball


@neuros_function(inputs="ball_in", outputs=Optional("ball_out"))
def hit(node, ball):
    node.get_ros_node().get_logger().info(f"stroke {ball.data}")
    if ball.data >= RALLY:
        node.shutdown(f"a rally of {ball.data} strokes")
        return None
    answer = node.make_packet("ball_out")
    answer.data = ball.data + 1
    return answer
