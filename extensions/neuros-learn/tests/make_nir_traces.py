"""Writes ``nir_traces``: networks of snnTorch and Norse, exported, and what these gave for them.

Run once, where both libraries are. Each network is stepped, and then exported, by its own library:
snnTorch 1.0.0 and Norse 1.1.0, with nirtorch 2.6, nir 1.0.8 and PyTorch 1.12.1.

For that old PyTorch, ``torch.fx`` was imported first, ``_register_pytree_node`` was given its later
name without the first underscore, and ``superspike_fn`` of Norse was replaced by ``heaviside``,
also Norse's, which is what it computes forwards. A newer PyTorch should need none of it.
"""

import inspect
from pathlib import Path

import nir
import norse.torch as norse
import numpy as np
import snntorch
import torch
from norse.torch.utils.export_nir import to_nir
from snntorch.export_nir import export_to_nir
from torch import nn

FOLDER = Path(__file__).parent / "nir_traces"
STEPS = 500
SUBTRACT = {"reset_mechanism": "subtract"}
ZERO = {"reset_mechanism": "zero"}
NOW = {"reset_delay": False}


def each(value, *shape):
    """One parameter per neuron: NIR's check of types refuses what snnTorch writes for a number."""
    return torch.full(shape, value)


def leaky(**options):
    options["init_hidden"] = True
    first = snntorch.Leaky(beta=each(0.9, 20), threshold=each(1.0, 20), **options)
    last = snntorch.Leaky(beta=each(0.6, 5), threshold=each(0.7, 5), **options)
    return nn.Sequential(nn.Linear(4, 20), first, nn.Linear(20, 5, bias=False), last)


def synaptic(**options):
    options |= {"alpha": each(0.7, 20), "beta": each(0.85, 20), "threshold": each(1.0, 20)}
    cells = snntorch.Synaptic(init_hidden=True, **options)
    return nn.Sequential(nn.Linear(4, 20), cells)


def recurrent(kind, **options):
    cells = getattr(snntorch, kind)(init_hidden=True, **options)
    return nn.Sequential(nn.Linear(4, 12), cells)


def convolution():
    return nn.Sequential(
        nn.Conv2d(2, 6, 3, stride=2, padding=1),
        snntorch.Leaky(beta=each(0.8, 6, 4, 4), threshold=each(1.0, 6, 4, 4), init_hidden=True),
        nn.AvgPool2d(2),
        nn.Flatten(),
        nn.Linear(24, 5),
        snntorch.Leaky(beta=each(0.9, 5), threshold=each(1.0, 5), init_hidden=True),
    )


ALL = {"beta": 0.8, "linear_features": 12}
ONE = {"beta": 0.8, "all_to_all": False, "V": torch.linspace(-0.5, 0.5, 12)}
SNNTORCH = {
    "leaky_subtract": lambda: leaky(**SUBTRACT),
    "leaky_subtract_now": lambda: leaky(**SUBTRACT, **NOW),
    "leaky_zero": lambda: leaky(**ZERO),
    "leaky_zero_now": lambda: leaky(**ZERO, **NOW),
    "synaptic_subtract": lambda: synaptic(**SUBTRACT),
    "synaptic_zero": lambda: synaptic(**ZERO),
    "rleaky_subtract": lambda: recurrent("RLeaky", **ALL, **SUBTRACT),
    "rleaky_zero": lambda: recurrent("RLeaky", **ALL, **ZERO),
    "rleaky_one_to_one": lambda: recurrent("RLeaky", **ONE),
    "rsynaptic_subtract": lambda: recurrent("RSynaptic", alpha=0.7, **ALL, **SUBTRACT),
    "convolution": convolution,
}
NORSE = {
    "norse_lif_box": lambda: norse.SequentialState(
        nn.Linear(4, 20), norse.LIFBoxCell(), nn.Linear(20, 5), norse.LIBoxCell()
    ),
    "norse_lif": lambda: norse.SequentialState(nn.Linear(4, 20), norse.LIFCell()),
    "norse_iaf": lambda: norse.SequentialState(nn.Linear(4, 20), norse.IAFCell()),
}


def write(name, graph, inputs, outputs):
    nir.write(FOLDER / f"{name}.nir", graph, compression=None)
    outputs = np.stack(outputs).astype(np.float32)
    if set(np.unique(outputs)) <= {0, 1}:
        outputs = outputs.astype(bool)
    np.savez_compressed(FOLDER / f"{name}.npz", inputs=inputs.astype(bool), outputs=outputs)
    print(name, outputs.shape, "mean", outputs.mean())


def main():
    FOLDER.mkdir(exist_ok=True)
    for seed, (name, make) in enumerate({**SNNTORCH, **NORSE}.items()):
        torch.manual_seed(seed)
        network = make()
        with torch.no_grad():
            for weights in network.parameters():
                if weights.ndim > 1:
                    weights *= 4.0 if name in NORSE else 2.0
        shape = (2, 8, 8) if name == "convolution" else (4,)
        inputs = np.random.default_rng(seed).random((STEPS, *shape)) < 0.4
        data, outputs, state = torch.from_numpy(inputs).float(), [], None
        with torch.no_grad():
            for each in data:
                if name in NORSE:
                    given, state = network(each[None], state)
                else:
                    given = network(each[None])
                outputs.append(given.numpy()[0])
        export = to_nir if name in NORSE else export_to_nir
        more = {} if name in NORSE else {"ignore_dims": [0]}
        more = {key: v for key, v in more.items() if key in inspect.signature(export).parameters}
        write(name, export(network, data[:1], **more), inputs, outputs)


if __name__ == "__main__":
    main()
