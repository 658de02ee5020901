import os
import time

from neuros.hooks import neuros_initialise, neuros_function, Optional

NAME   = os.environ["PLAYER"]
SERVES = int(os.environ["SERVES"])
DELAY  = float(os.environ["DELAY"])


def hit(node, sound):
    ball = node.make_packet("ball_out")
    ball.data = sound
    node.get_ros_node().get_logger().info(f"{NAME} plays {sound}")
    return ball


@neuros_initialise(outputs=Optional("ball_out"))
def first_ball(node):
    if SERVES:
        return hit(node, "ping")


@neuros_function(inputs="ball_in", outputs="ball_out")
def next_ball(node, ball):
    time.sleep(DELAY)
    return hit(node, "pong" if ball.data == "ping" else "ping")
