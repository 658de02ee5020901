"""A ring of 60 neurons: its bump goes round once in two simulated seconds, a step is 10 ms."""

import math
import time

from neuros.hooks import neuros_function, neuros_initialise

NEURONS, STEP_S, ROUND_S = 60, 0.01, 2.0
PEAK_HZ, WIDTH = 100.0, 0.5


@neuros_initialise()
def start(node):
    node.set_user_data({"step": 0})


@neuros_function(outputs="rates")
def run(node):
    state = node.get_user_data()
    state["step"] += 1
    time.sleep(STEP_S)
    middle = 2 * math.pi * state["step"] * STEP_S / ROUND_S
    rates = node.make_packet("rates")
    rates.data = [
        PEAK_HZ * math.exp((math.cos(2 * math.pi * each / NEURONS - middle) - 1) / WIDTH**2)
        for each in range(NEURONS)
    ]
    return rates
