"""Balances the pole with the policy of the file POLICY.

weights.txt has the four weights that train.py has learnt, network.npz the network of train_sb3.py.
"""

import os

import numpy as np

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise

RATE_HZ = 50
FALLEN_RAD, END_M = 0.2, 2.4


def linear(weights):
    """A policy that weighs the positions and velocities of cart and pole: one layer."""
    return [(np.reshape(weights, (1, 4)), np.zeros(1))]


def read(file):
    """The layers of a policy, weights and biases each, from the first to the last."""
    if file.suffix == ".txt":
        return linear(np.loadtxt(file))
    with np.load(file) as arrays:
        count = len(arrays.files) // 2
        return [(arrays[f"weights{n}"], arrays[f"biases{n}"]) for n in range(count)]


def push(layers, position, velocity):
    """The force, from -1 to 1, for positions and velocities of cart and pole."""
    values = np.concatenate([position, velocity])
    for weights, biases in layers[:-1]:
        values = np.tanh(weights @ values + biases)
    weights, biases = layers[-1]
    return float(np.clip(weights @ values + biases, -1.0, 1.0)[0])


def has_fallen(position):
    """Whether the cart is at the end of its rail, or the pole too far from upright."""
    return abs(position[0]) > END_M or abs(position[1]) > FALLEN_RAD


@neuros_initialise()
def start(node):
    layers = read(node.resolve_path(os.environ["POLICY"]))
    node.set_user_data({"layers": layers, "upright": 0})


@neuros_function(inputs="joints", outputs="force")
def act(node, joints):
    own = node.get_user_data()
    own["upright"] += not has_fallen(joints.position)
    force = node.make_packet("force")
    force.data = push(own["layers"], joints.position, joints.velocity)
    return force


@neuros_finalise()
def end(node):
    own = node.get_user_data()
    if own is None:  # ended before the start
        return
    upright_s = own["upright"] / RATE_HZ
    node.set_result("upright_s", upright_s)
    node.get_logger().info(f"upright for {upright_s:.1f} s")
