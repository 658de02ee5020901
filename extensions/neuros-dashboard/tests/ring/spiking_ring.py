"""The ring with spikes: in each step of 10 ms, the 11 of 60 neurons in the bump fire once."""

import time

from neuros.hooks import neuros_function, neuros_initialise

NEURONS, IN_BUMP, STEP_S = 60, 11, 0.01


@neuros_initialise()
def start(node):
    node.set_user_data({"step": 0})


@neuros_function(outputs="spikes")
def run(node):
    state = node.get_user_data()
    state["step"] += 1
    time.sleep(STEP_S)
    spikes = node.make_packet("spikes")
    spikes.size = NEURONS
    first = state["step"] // 3
    spikes.senders = [(first + each) % NEURONS for each in range(IN_BUMP)]
    spikes.times = [state["step"] * STEP_S] * IN_BUMP
    stamp = spikes.header.stamp
    stamp.sec, stamp.nanosec = divmod(state["step"] * 10_000_000, 1_000_000_000)
    return spikes
