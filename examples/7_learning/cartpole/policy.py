"""Balances the pole with what train.py has learnt: four weights in weights.txt."""

import numpy as np

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise

RATE_HZ = 50
FALLEN_RAD, END_M = 0.2, 2.4


def push(weights, position, velocity):
    """The force, from -1 to 1, for positions and velocities of cart and pole."""
    return float(np.clip(weights @ np.concatenate([position, velocity]), -1.0, 1.0))


def has_fallen(position):
    """Whether the cart is at the end of its rail, or the pole too far from upright."""
    return abs(position[0]) > END_M or abs(position[1]) > FALLEN_RAD


@neuros_initialise()
def start(node):
    node.set_user_data({"weights": np.loadtxt(node.resolve_path("weights.txt")), "upright": 0})


@neuros_function(inputs="joints", outputs="force")
def act(node, joints):
    own = node.get_user_data()
    own["upright"] += not has_fallen(joints.position)
    force = node.make_packet("force")
    force.data = push(own["weights"], joints.position, joints.velocity)
    return force


@neuros_finalise()
def end(node):
    upright_s = node.get_user_data()["upright"] / RATE_HZ
    node.set_result("upright_s", upright_s)
    node.get_logger().info(f"upright for {upright_s:.1f} s")
