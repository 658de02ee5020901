"""The network in PyNN: each eye excites the motor neuron of the other side.

``pyNN.nest`` may be any other simulator that PyNN has, here and in ``containers/light_pynn``.
"""

import os

import pyNN.nest as sim

from neuros.hooks import neuros_function, neuros_initialise

STEP_MS = 20.0
CELLS = 8
CURRENTS_NA = 0.8, 0.7  # in the dark, and what full light adds
WEIGHT_NA = 0.6


class Brain:
    def __init__(self, seed):
        sim.setup(timestep=0.1, min_delay=1.0, rng_seed=seed)
        cell = sim.IF_curr_exp(v_rest=-65.0, v_reset=-65.0, v_thresh=-50.0, tau_refrac=2.0)
        self.motors = sim.Population(2, cell, label="motors")
        self.motors.record("spikes")
        self.lights = [self.eye(motor, cell, seed) for motor in (1, 0)]

    def eye(self, motor, cell, seed):
        cells = sim.Population(CELLS, cell)
        start = sim.RandomDistribution("uniform", (-65.0, -50.0), rng=sim.NumpyRNG(seed + motor))
        cells.initialize(v=start)
        synapse = sim.StaticSynapse(weight=WEIGHT_NA, delay=1.0)
        sim.Projection(cells, self.motors[[motor]], sim.AllToAllConnector(), synapse)
        light = sim.DCSource(amplitude=0.0)
        light.inject_into(cells)
        return light

    def step(self, light):
        """Spikes of the left and the right motor neuron, with that much light on either eye."""
        dark_na, light_na = CURRENTS_NA
        for source, amount in zip(self.lights, light, strict=True):
            source.amplitude = dark_na + light_na * amount
        sim.run(STEP_MS)
        recorded = self.motors.get_data("spikes", clear=True)  # else each step takes longer
        return [len(spikes) for spikes in recorded.segments[-1].spiketrains]


@neuros_initialise()
def start(node):
    node.set_user_data(Brain(int(os.environ["SEED"])))


@neuros_function(inputs="light", outputs="spikes")
def see(node, light):
    spikes = node.make_packet("spikes")
    spikes.data = [float(number) for number in node.get_user_data().step(light.data)]
    return spikes
