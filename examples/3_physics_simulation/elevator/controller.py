"""Sends the cabin on a tour: TOUR is a list of levels, separated by blanks."""

import os

from neuros.hooks import neuros_function, neuros_initialise
from neuros.time import to_seconds

LEVEL_HEIGHTS_M = (0.0, 3.0, 6.0, 9.0)
CLOSE_M, SLOW_M_PER_S = 0.02, 0.02


@neuros_initialise()
def start(node):
    node.set_user_data([int(level) for level in os.environ["TOUR"].split()])


# Every reading is answered with the present target: where packets may be lost, the next one makes
# up for it.
@neuros_function(inputs="cabin", outputs="target")
def control(node, cabin):
    tour = node.get_user_data()
    if has_arrived(cabin, LEVEL_HEIGHTS_M[tour[0]]):
        node.get_logger().info(f"level {tour[0]} after {to_seconds(cabin):.2f} s")
        if len(tour) == 1:
            node.shutdown("the tour is over")
        else:
            tour.pop(0)
    target = node.make_packet("target")
    target.data = LEVEL_HEIGHTS_M[tour[0]]
    return target


def has_arrived(cabin, height_m):
    """Whether the cabin stands at a height."""
    is_close = abs(cabin.position[0] - height_m) < CLOSE_M
    return is_close and abs(cabin.velocity[0]) < SLOW_M_PER_S
