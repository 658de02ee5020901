"""Granule cells, Purkinje cells, and climbing fibres that teach them to hold the gaze.

The cerebellum as an adaptive filter: see P. Dean, J. Porrill, C.-F. Ekerot and H. Jörntell, "The
cerebellar microcircuit as an adaptive filter: experimental and computational evidence", Nature
Reviews Neuroscience 11, 2010.
"""

import os

import numpy as np

from neuros.hooks import Optional, neuros_finalise, neuros_function, neuros_initialise
from neuros.snn import SpikeReader, Stepper, Weights, derive_seed, reset_kernel

WIRING_SEED = 1  # of granule cells: equal in all runs, so that weights mean the same
GRANULES = 100
MOSSY, PURKINJES, CLIMBING = 20, 10, 10  # on each side
STEP_S = 0.02
TURN_RAD_S = 1.5  # of the head, at which mossy fibres of one side are silent
MOSSY_HZ = 60.0  # while the head rests
DEPTH_PA = 300.0  # into a granule cell, at that turn
BIAS_PA = 300.0, 450.0  # of a granule cell
FASTEST_MS = 4.0  # time constant of a granule cell's synapses
SLIP_RAD_S = 0.6  # of the picture, at which climbing fibres of one side are silent
CLIMBING_HZ = 10.0  # while the picture rests
REFLEX = 0.6  # rad/s of the eye for one of the head, without a cerebellum
PULL_RAD_S = 0.012  # of the eye, for one Hz more of Purkinje cells on one side than on the other
SMOOTH_S = 0.08
WEIGHTS_EVERY_NS = 1_000_000_000
FIRST_PA, LARGEST_PA = 30.0, 60.0
SYNAPSE = {
    "A_plus": -0.03,  # a granule cell fires before a Purkinje cell: depression is due ...
    "A_minus": 0.0,
    "tau_c": 50.0,  # ... for 50 ms: what the picture does now, commands have caused before
    "tau_n": 10.0,  # ms that a spike of a climbing fibre lasts
    "b": CLIMBING * CLIMBING_HZ / 1000.0,  # of their spikes per ms that change nothing
    "Wmin": 0.0,
    "Wmax": LARGEST_PA,
}


class Brain:
    def __init__(self, seed, learns, slowest_ms):
        nest = reset_kernel(seed)
        mossy = nest.Create("parrot_neuron", 2 * MOSSY)
        granules = nest.Create("iaf_psc_exp", GRANULES)
        purkinjes = nest.Create("iaf_psc_exp", 2 * PURKINJES, {"tau_syn_ex": 5.0, "I_e": 350.0})
        climbing = nest.Create("parrot_neuron", 2 * CLIMBING)
        # Poisson generators send other spikes of the same rate to each cell.
        self.inputs = nest.Create("poisson_generator", 4)
        for number, cells in enumerate((mossy[:MOSSY], mossy[MOSSY:])):
            nest.Connect(self.inputs[number], cells)
        for number, cells in enumerate((climbing[:CLIMBING], climbing[CLIMBING:])):
            nest.Connect(self.inputs[2 + number], cells)
            transmitter = nest.Create("volume_transmitter", params={"deliver_interval": 10})
            nest.Connect(cells, transmitter)
            own = {**SYNAPSE, "volume_transmitter": transmitter}
            nest.CopyModel("stdp_dopamine_synapse", f"learning_{number}", own)
            side = purkinjes[number * PURKINJES : (number + 1) * PURKINJES]
            model = f"learning_{number}" if learns else "static_synapse"
            nest.Connect(granules, side, syn_spec={"synapse_model": model, "weight": FIRST_PA})
        self.expand(nest, mossy, granules, slowest_ms)
        nest.Connect(nest.Create("noise_generator", params={"std": 100.0}), granules)
        nest.Connect(nest.Create("noise_generator", params={"std": 60.0}), purkinjes)
        self.stepper = Stepper()
        self.reader = SpikeReader(purkinjes, self.stepper)
        self.weights = Weights(granules, purkinjes)  # left cells first
        self.pull = 0.0

    @staticmethod
    def expand(nest, mossy, granules, slowest_ms):
        """One side excites a granule cell, the other inhibits it, for a time of its own."""
        random = np.random.default_rng(WIRING_SEED)
        slow_ms = np.exp(random.uniform(np.log(FASTEST_MS), np.log(slowest_ms), GRANULES))
        granules.set({"tau_syn_ex": slow_ms, "tau_syn_in": slow_ms})
        granules.I_e = random.uniform(*BIAS_PA, GRANULES)
        preferred = random.choice([-1.0, 1.0], GRANULES)
        charge = DEPTH_PA * 1000.0 / (2 * MOSSY * MOSSY_HZ)  # pA ms
        weights = np.repeat([1.0, -1.0], MOSSY)[:, None] * (charge * preferred / slow_ms)
        nest.Connect(mossy, granules, "all_to_all", {"weight": weights.T})

    def step(self, turn, error):
        """The command for the eye (rad/s), from the head's turn and the error (rad/s)."""
        turned = MOSSY_HZ * np.clip(turn / TURN_RAD_S, -1.0, 1.0)
        missed = CLIMBING_HZ * np.clip(error / SLIP_RAD_S, -1.0, 1.0)
        # A picture that slips to the left needs an eye that turns further to the right.
        at_rest = np.repeat([MOSSY_HZ, CLIMBING_HZ], 2)
        self.inputs.rate = at_rest + np.array([turned, -turned, -missed, missed])
        self.stepper.advance_s(STEP_S)
        spikes = np.bincount(self.reader.read().neuron // PURKINJES, minlength=2)
        left, right = spikes / (PURKINJES * STEP_S)
        # Purkinje cells inhibit: those of a side hold back what turns the eye to that side.
        self.pull += STEP_S / SMOOTH_S * (PULL_RAD_S * (right - left) - self.pull)
        return self.pull - REFLEX * turn


@neuros_initialise()
def start(node):
    seed = derive_seed(int(os.environ["SEED"]), node.name)
    brain = Brain(seed, os.environ["LEARN"] == "1", float(os.environ["SLOWEST_MS"]))
    node.set_user_data(brain)
    node.keep("weights", brain.weights.read, brain.weights.write)


@neuros_function(inputs=["turn", "error"], outputs=["muscle", Optional("weights")])
def act(node, turn, error):
    brain = node.get_user_data()
    muscle = np.array([brain.step(turn[0], error[0])])
    is_due = brain.stepper.time_ns % WEIGHTS_EVERY_NS == 0
    return muscle, brain.weights.read() if is_due else None


@neuros_finalise()
def end(node):
    if brain := node.get_user_data():
        brain.stepper.close()
