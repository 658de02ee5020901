"""The spiking network that integrates the gyroscope into a heading, in Nengo."""

import os

from nengo_ring import NengoRing
from snn import GyroIntegrator, integrate

from neuros.hooks import neuros_initialise

__all__ = ["integrate", "start"]


@neuros_initialise()
def start(node):
    network = NengoRing(seed=int(os.environ.get("SEED", "1")))
    network.settle()
    bias_rad_s = float(os.environ.get("GYRO_BIAS", "0"))
    node.set_user_data(GyroIntegrator(network, bias_rad_s))
