"""A central pattern generator for four legs: two groups of cells per leg that suppress each other.

Each group tires (spike-frequency adaptation), so that one hands over to the other: a half-centre
oscillator, after T. G. Brown, "On the nature of the fundamental activity of the nervous centres",
Journal of Physiology 48, 1914. The cells are those of R. Brette and W. Gerstner, "Adaptive
exponential integrate-and-fire model", Journal of Neurophysiology 94, 2005.
"""

import os

import numpy as np

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise
from neuros.snn import RateInput, SpikeReader, Stepper, derive_seed, reset_kernel

LEGS = 4  # in a ring: front left, hind left, hind right, front right
CELLS = 10  # of each group: swing and stance of each leg, and touch of each foot
STEP_S = 0.02
HALVES_PA = -40.0  # from each cell of a leg's swing to each of its stance, and back
TOUCH_HZ = 100.0  # of a cell of touch, while its foot is on the ground
SYNAPSE_MS = 20.0  # how long the current of a spike lasts
FULL_HZ = 40.0  # how much faster one half fires than the other, for full power
SMOOTH_S = 0.05
CELL = {
    "I_e": 900.0,
    "a": 0.0,
    "b": 40.0,  # pA that each spike adds to the adaptation ...
    "tau_w": 400.0,  # ... which decays so slowly, in ms
    "tau_syn_ex": SYNAPSE_MS,
    "tau_syn_in": SYNAPSE_MS,
}


class Brain:
    """Weights are in pA. ``feedback_pa`` is the mean current from the touch of a foot.

    It excites the stance of its leg and inhibits the swing; if it is negative, the other way round.
    """

    def __init__(self, seed, coupling_pa, feedback_pa):
        nest = reset_kernel(seed, resolution_ms=0.5)
        cells = nest.Create("aeif_psc_exp", LEGS * 2 * CELLS, CELL)
        nest.Connect(nest.Create("noise_generator", params={"std": 100.0, "dt": 1.0}), cells)
        groups = [cells[first : first + CELLS] for first in range(0, len(cells), CELLS)]
        swing, stance = groups[0::2], groups[1::2]
        touch = nest.Create("parrot_neuron", LEGS * CELLS)
        spike_pa = feedback_pa / (CELLS * TOUCH_HZ * SYNAPSE_MS / 1000.0)
        for leg in range(LEGS):
            foot = touch[leg * CELLS : (leg + 1) * CELLS]
            for half, other, sign in ((swing, stance, -1.0), (stance, swing, 1.0)):
                nest.Connect(half[leg], other[leg], syn_spec={"weight": HALVES_PA})
                for neighbour in ((leg + 1) % LEGS, (leg - 1) % LEGS):
                    nest.Connect(half[leg], half[neighbour], syn_spec={"weight": coupling_pa})
                nest.Connect(foot, half[leg], syn_spec={"weight": sign * spike_pa})
        self.touch = RateInput(touch, weight=1.0)
        self.stepper = Stepper()
        self.reader = SpikeReader(cells, self.stepper)
        self.power = np.zeros(LEGS)

    def step(self, touch):
        """The power of each leg, -1 (swing) to 1 (stance), after another step."""
        self.touch.set_rates(np.repeat(TOUCH_HZ * touch, CELLS))
        self.stepper.advance_s(STEP_S)
        spikes = np.bincount(self.reader.read().neuron // CELLS, minlength=2 * LEGS)
        swing_hz, stance_hz = spikes.reshape(LEGS, 2).T / (CELLS * STEP_S)
        wanted = (stance_hz - swing_hz) / FULL_HZ
        self.power += (1 - np.exp(-STEP_S / SMOOTH_S)) * (wanted - self.power)
        return np.clip(self.power, -1.0, 1.0)


@neuros_initialise()
def start(node):
    seed = derive_seed(int(os.environ["SEED"]), node.name)
    weights = (float(os.environ[name]) for name in ("COUPLING_PA", "FEEDBACK_PA"))
    node.set_user_data(Brain(seed, *weights))


@neuros_function(inputs="touch", outputs="power")
def act(node, touch):
    return node.get_user_data().step(touch)


@neuros_finalise()
def end(node):
    if brain := node.get_user_data():
        brain.stepper.close()
