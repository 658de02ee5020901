"""A chair that turns a head to and fro, and the error that its eye makes.

The way is a sum of three sines whose frequencies and phases come from the seed.
"""

import os

import numpy as np

from neuros.hooks import neuros_function, neuros_initialise

STEP_S = 0.02
LOWEST_HZ, HIGHEST_HZ = (0.15, 0.3, 0.45), (0.3, 0.45, 0.6)
EACH_RAD_S = 0.4  # the amplitude of each sine
BLOCK = 250  # steps, of 5 s, for each of which the slip is reported


class Chair:
    def __init__(self, seed, scale, sign):
        random = np.random.default_rng(seed)
        self.frequencies_hz = random.uniform(LOWEST_HZ, HIGHEST_HZ)
        self.phases = random.uniform(0.0, 2.0 * np.pi, 3)
        self.amplitude_rad_s = scale * EACH_RAD_S
        self.sign = sign  # 1 tells the error, -1 inverts it, 0 tells none
        self.steps = 0
        self.squares = []  # of the head's turn and of the slip, in each step

    def turn(self):
        """How fast the chair turns, rad/s."""
        angles = 2.0 * np.pi * self.frequencies_hz * self.steps * STEP_S + self.phases
        return self.amplitude_rad_s * np.sin(angles).sum()

    def slips(self):
        """For each block of 5 s: RMS of the slip, as a share of that of the head's turn."""
        blocks = np.array(self.squares).reshape(-1, BLOCK, 2).mean(1)
        return np.sqrt(blocks[:, 1] / blocks[:, 0])


@neuros_initialise()
def start(node):
    seed, scale = int(os.environ["SEED"]), float(os.environ["SCALE"])
    node.set_user_data(Chair(seed, scale, float(os.environ["ERROR"])))


@neuros_function(inputs=["turn", "slip"], outputs=["chair", "error"])
def tell(node, turn, slip):
    chair = node.get_user_data()
    chair.steps += 1
    chair.squares.append((turn[0] ** 2, slip[0] ** 2))
    if chair.steps % BLOCK == 0:
        report(node, chair)
    return np.array([chair.turn()]), chair.sign * slip


def report(node, chair):
    slips = chair.slips()
    node.set_result("slip", slips.tolist())
    seconds = round(chair.steps * STEP_S)
    if len(slips) % 2 == 0:
        node.get_logger().info(f"{seconds} s: {100 * np.mean(slips[-2:]):.0f} % of the turns slip")
    if seconds >= float(os.environ["SECONDS"]):
        node.shutdown(f"{seconds} s of turns")
