"""Tools for nodes with spiking networks.

- :mod:`~neuros.snn.coding`, with NumPy alone: rates to spikes, spikes to rates, population codes.
- :mod:`~neuros.snn.nest`, around NEST: seeds and threads, exact steps, rates and spikes in, spikes
  out.

The first call of the second module imports NEST. Times are in seconds and rates in hertz unless a
name says otherwise (``_ms``, ``_ns``).
"""

from neuros.snn.coding import (
    CosineTuning,
    Direction,
    ExponentialRate,
    GaussianTuning,
    LeakyIntegrator,
    PopulationVector,
    RegularEncoder,
    Spikes,
    WindowRate,
    centre_of_mass,
    evenly_spaced_angles,
    poisson_spikes,
)
from neuros.snn.nest import (
    PartialDelayWarning,
    RateInput,
    SpikeInput,
    SpikeReader,
    Stepper,
    Weights,
    derive_seed,
    import_nest,
    reset_kernel,
    threads_of_node,
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
    "Weights",
    "WindowRate",
    "centre_of_mass",
    "derive_seed",
    "evenly_spaced_angles",
    "import_nest",
    "poisson_spikes",
    "reset_kernel",
    "threads_of_node",
]
