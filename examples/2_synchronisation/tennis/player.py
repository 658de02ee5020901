"""A tennis player: hits back every ball that comes.

The player with a RALLY in its environment serves, and catches the ball after that many strokes.
"""

import os

from neuros.hooks import Optional, neuros_function, neuros_initialise

RALLY = int(os.environ.get("RALLY", "0"))


# Both players have this hook, and only one of them serves: hence Optional.
@neuros_initialise(outputs=Optional("ball_out"))
def serve(node):
    return stroke(node, 1) if RALLY else None


@neuros_function(inputs="ball_in", outputs=Optional("ball_out"))
def hit(node, ball):
    if RALLY and ball.data >= RALLY:
        node.shutdown(f"a rally of {ball.data} strokes")
        return None
    return stroke(node, ball.data + 1)


def stroke(node, number):
    node.get_logger().info(f"stroke {number}")
    ball = node.make_packet("ball_out")
    ball.data = number
    return ball
