"""Tools for nodes with spiking networks.

- Coders and decoders, with NumPy alone: :mod:`~neuros.snn.encoding` (rates to spikes),
  :mod:`~neuros.snn.decoding` (spikes to rates), :mod:`~neuros.snn.tuning` (population codes).
- Around NEST: :mod:`~neuros.snn.kernel` (seeds and threads), :mod:`~neuros.snn.stepper` (exact
  steps), :mod:`~neuros.snn.devices` (rates and spikes in, spikes out).

NEST is imported when the first of the second kind is used. Times are in seconds and rates in hertz
unless a name says otherwise (``_ms``, ``_ns``).
"""

from neuros.snn.decoding import ExponentialRate, LeakyIntegrator, WindowRate
from neuros.snn.devices import RateInput, SpikeInput, SpikeReader
from neuros.snn.encoding import RegularEncoder, poisson_spikes
from neuros.snn.kernel import derive_seed, import_nest, reset_kernel, threads_of_node
from neuros.snn.spikes import Spikes
from neuros.snn.stepper import PartialDelayWarning, Stepper
from neuros.snn.tuning import (
    CosineTuning,
    Direction,
    GaussianTuning,
    PopulationVector,
    centre_of_mass,
    evenly_spaced_angles,
)

__all__ = [
    "CosineTuning",
    "Direction",
    "ExponentialRate",
    "GaussianTuning",
    "LeakyIntegrator",
    "PartialDelayWarning",
    "PopulationVector",
    "RateInput",
    "RegularEncoder",
    "SpikeInput",
    "SpikeReader",
    "Spikes",
    "Stepper",
    "WindowRate",
    "centre_of_mass",
    "derive_seed",
    "evenly_spaced_angles",
    "import_nest",
    "poisson_spikes",
    "reset_kernel",
    "threads_of_node",
]
