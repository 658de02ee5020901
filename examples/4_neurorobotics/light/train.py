"""Trains the network with snnTorch, and writes brain.nir: pip install torch snntorch nir.

Each motor neuron is to fire the more, the more the eye on the other side sees.
"""

from pathlib import Path

import nir
import snntorch
import torch
from snntorch import utils
from snntorch.export_nir import export_to_nir
from torch import nn

STEPS = 50
BATCH = 64
HIDDEN = 16


def wanted_rates(light):
    """Spikes per step of the left and right motor neuron, for light on the left and right eye."""
    return 0.1 + 0.8 * light.flip(1)


def cells(number):
    """Leaky integrate-and-fire; one parameter per cell, as the types of NIR want it."""
    ones = torch.ones(number)
    return snntorch.Leaky(beta=0.9 * ones, threshold=ones, init_hidden=True)


def main():
    torch.manual_seed(1)
    torch.set_num_threads(1)
    network = nn.Sequential(nn.Linear(2, HIDDEN), cells(HIDDEN), nn.Linear(HIDDEN, 2), cells(2))
    optimiser = torch.optim.Adam(network.parameters(), lr=0.01)
    for round_ in range(300):
        light = torch.rand(BATCH, 2)
        utils.reset(network)
        rates = torch.stack([network(light) for _ in range(STEPS)]).mean(0)
        loss = ((rates - wanted_rates(light)) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if round_ % 50 == 49:
            print(f"round {round_ + 1}: the rates are off by {loss.item() ** 0.5:.3f}")
    utils.reset(network)
    graph = export_to_nir(network, torch.rand(1, 2), ignore_dims=[0])  # which is of the batch
    nir.write(Path(__file__).with_name("brain.nir"), graph, compression=None)


if __name__ == "__main__":
    main()
