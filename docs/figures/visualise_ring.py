"""Makes visualise_ring.png: python docs/figures/visualise_ring.py."""

import os
from pathlib import Path

import numpy as np

from neuros.visualise import VisualiseRing

os.environ["NEUROS_RUN_DIR"] = str(Path(__file__).parent)
NEURONS, RATE_RAD_S = 120, 0.8

random = np.random.default_rng(1)
preferred = 2 * np.pi * (np.arange(NEURONS) + 0.5) / NEURONS
figure = VisualiseRing("visualise ring", duration=20)
figure.add_ring("left")
figure.add_ring("right", "C3")
for time_s in np.arange(0, 20, 0.02):
    bump_hz = 40 * np.exp(4 * (np.cos(preferred - RATE_RAD_S * time_s) - 1))
    figure.plot("left", bump_hz + 3 * random.random(NEURONS), time_s)
    figure.plot("right", 0.7 * bump_hz + 3 * random.random(NEURONS), time_s)
figure.close()
