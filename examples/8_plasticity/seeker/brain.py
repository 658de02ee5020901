"""Two eyes excite two motors; dopamine decides which of the synapses between them grow.

Reward-modulated STDP, after E. Izhikevich, "Solving the distal reward problem through linkage of
STDP and dopamine signaling", Cerebral Cortex 17, 2007. Dopamine signals how much larger a reward is
than expected: see N. Frémaux et al., "Functional requirements for reward-modulated
spike-timing-dependent plasticity", Journal of Neuroscience 30, 2010.
"""

import os

import numpy as np

from neuros.hooks import Optional, neuros_finalise, neuros_function, neuros_initialise
from neuros.snn import RateInput, SpikeReader, Stepper, Weights, derive_seed, reset_kernel

CELLS = 10  # in each eye, in each motor, and of dopamine
STEP_S = 0.02
EYE_HZ = 80.0  # in full light
DOPAMINE_HZ = 20.0  # for an expected reward
FIRST_PA, LARGEST_PA = 30.0, 100.0
WHEEL_RAD_S = 0.6  # for one spike in a step
WEIGHTS_EVERY_NS = 1_000_000_000
SYNAPSE = {
    "A_plus": 0.01,  # a cell of an eye fires before one of a motor ...
    "A_minus": 0.0,
    "tau_c": 200.0,  # ... and the synapse remembers that for 200 ms
    "tau_n": 50.0,  # ms that dopamine stays
    "b": CELLS * DOPAMINE_HZ / 1000.0,  # spikes of dopamine per ms that change nothing
    "Wmin": 0.0,
    "Wmax": LARGEST_PA,
}


class Brain:
    def __init__(self, seed, learns, expect_s):
        nest = reset_kernel(seed)
        eyes = nest.Create("parrot_neuron", 2 * CELLS)
        motors = nest.Create("iaf_psc_exp", 2 * CELLS, {"tau_syn_ex": 5.0, "tau_syn_in": 5.0})
        dopamine = nest.Create("parrot_neuron", CELLS)
        left, right = motors[:CELLS], motors[CELLS:]
        for motor, other in ((left, right), (right, left)):
            nest.Connect(motor, other, syn_spec={"weight": -40.0})
            # Each motor tries something else every 400 ms.
            trial = nest.Create("noise_generator", params={"mean": 330, "std": 60, "dt": 400})
            nest.Connect(trial, motor)
            nest.Connect(nest.Create("noise_generator", params={"std": 150}), motor)
        transmitter = nest.Create("volume_transmitter")
        nest.Connect(dopamine, transmitter)
        own = {**SYNAPSE, "volume_transmitter": transmitter}
        nest.CopyModel("stdp_dopamine_synapse", "learning", own)
        model = "learning" if learns else "static_synapse"
        nest.Connect(eyes, motors, syn_spec={"synapse_model": model, "weight": FIRST_PA})
        self.light = RateInput(eyes, weight=1.0)
        self.dopamine = RateInput(dopamine, weight=1.0)
        self.stepper = Stepper()
        self.reader = SpikeReader(motors, self.stepper)
        self.weights = Weights(eyes, motors)  # left cells first
        self.expected, self.share = 0.0, STEP_S / expect_s
        self.wheels = np.zeros(2)

    def step(self, light, reward):
        surprise = reward - self.expected
        self.expected += self.share * surprise
        self.light.set_rates(np.repeat(EYE_HZ * light, CELLS))
        self.dopamine.set_rates(np.full(CELLS, DOPAMINE_HZ * max(0.0, 1.0 + surprise)))
        self.stepper.advance_s(STEP_S)
        spikes = np.bincount(self.reader.read().neuron // CELLS, minlength=2)
        self.wheels = 0.5 * self.wheels + 0.5 * WHEEL_RAD_S * spikes
        return self.wheels


@neuros_initialise()
def start(node):
    seed = derive_seed(int(os.environ["SEED"]), node.name)
    brain = Brain(seed, os.environ["LEARN"] == "1", float(os.environ["EXPECT_S"]))
    node.set_user_data(brain)
    node.keep("weights", brain.weights.read, brain.weights.write)


@neuros_function(inputs=["eyes", "reward"], outputs=["wheels", Optional("weights")])
def act(node, eyes, reward):
    brain = node.get_user_data()
    wheels = brain.step(eyes, reward[0])
    is_due = brain.stepper.time_ns % WEIGHTS_EVERY_NS == 0
    return wheels, brain.weights.read() if is_due else None


@neuros_finalise()
def end(node):
    if brain := node.get_user_data():
        brain.stepper.close()
