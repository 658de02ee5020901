"""A plant: its state and a picture of it, after each action."""

import os

import numpy as np

from neuros.hooks import Optional, neuros_function, neuros_initialise

ROUNDS = int(os.environ["ROUNDS"])


@neuros_initialise(outputs=["state", "picture", "number"])
def begin(node):
    node.set_user_data(np.array([1.0, -2.0, 0.5]))
    return look(node, 0)


@neuros_function(
    inputs=["action", "number", Optional("push")], outputs=["state", "picture", "number"]
)
def step(node, action, number, push):
    for received in (action, number):
        assert type(received) is np.ndarray
        assert not received.flags.writeable
    state = node.get_user_data()
    state[:2] += 0.1 * action
    if push is not None:
        state[2] = push.sum()
    if number[0] == ROUNDS:
        node.shutdown("that is enough")
    return look(node, number[0] + 1)


def look(node, count):
    state = node.get_user_data()
    picture = node.make_packet("picture")
    picture[:, :, 0] = count % 256
    picture[count % 200, :, 1:] = state[:2].view(np.uint8)[:2]
    number = node.make_packet("number")
    number[0] = count
    return state, picture, number  # the state goes on being changed
