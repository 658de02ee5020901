"""Writes policies of Stable-Baselines3 and PyTorch in ONNX, for nodes with ``"policy"``."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import Port

OPSET = 17
_ACTION, _OBSERVATION = "action", "observation"


def export(model: Any, file: str | os.PathLike[str], world: Any) -> dict[str, Any]:
    """Write a policy, and return the node that runs it: see ``neuros.gym.export_policy``.

    ``world`` is the environment of :mod:`~neuros_learn.gym` that the policy was trained in.
    """
    try:
        import torch
    except ImportError as error:
        raise EnvironmentFault(
            "a policy is exported by PyTorch, which is not installed: pip install torch"
        ) from error
    seen, done = world.observation_signals, world.action_signals
    low, high = (
        np.concatenate([np.ravel(getattr(each.space, side)) for each in done]).astype(np.float32)
        for side in ("low", "high")
    )
    is_sb3 = hasattr(model, "policy") and hasattr(model, "get_vec_normalize_env")
    network = copy.deepcopy(model.policy if is_sb3 else model).to("cpu").eval()
    shape, dtype = _observed(
        network.observation_space if is_sb3 else None,
        [each.name for each in seen],
        sum(prod(each.space.shape) for each in seen),
    )
    normaliser = model.get_vec_normalize_env() if is_sb3 else None
    statistics: list[Any] = []
    if normaliser is not None and normaliser.norm_obs:
        found = normaliser.obs_rms
        arrays = (found.mean, np.sqrt(found.var + normaliser.epsilon))
        statistics = [torch.from_numpy(each.astype(np.float32)) for each in arrays]
        statistics.append(float(normaliser.clip_obs))

    class Exported(torch.nn.Module):  # type: ignore[misc, unused-ignore]
        """From observations as packets have them to actions as packets have them."""

        def __init__(self) -> None:
            super().__init__()
            self.network = network
            self.low, self.high = torch.from_numpy(low), torch.from_numpy(high)

        def forward(self, observation: Any) -> Any:
            if statistics:
                mean, deviation, most = statistics
                observation = torch.clamp((observation - mean) / deviation, -most, most)
            if not is_sb3:
                return torch.clamp(self.network(observation), self.low, self.high)
            action = self.network._predict(observation, deterministic=True)
            if self.network.squash_output:
                return self.low + (0.5 * (action + 1.0) * (self.high - self.low))
            return torch.clamp(action, self.low, self.high)

    with torch.no_grad(), warnings.catch_warnings():
        # The exporter that follows the calls of a module, which all of Stable-Baselines3 passes.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Exported(),
            (torch.from_numpy(np.zeros((1, *shape), dtype)),),
            os.fspath(file),
            input_names=[_OBSERVATION],
            output_names=[_ACTION],
            dynamic_axes={_OBSERVATION: {0: "batch"}, _ACTION: {0: "batch"}},
            opset_version=OPSET,
            dynamo=False,
        )
    return _node(world, Path(file).name)


def _observed(space: Any, names: Sequence[str], count: int) -> tuple[Sequence[int], Any]:
    """Shape and type of the policy's observation, which joins all that the environment gives.

    Raises:
        UsageError: the policy observes something else.
    """
    if space is None:
        return (count,), np.float32
    if space.shape is None or prod(space.shape) != count:
        raise UsageError(
            f"the policy observes {space}, and its environment gives {', '.join(names)}"
            f" ({count} numbers): a wrapper that changes observations cannot be exported"
        )
    return space.shape, np.uint8 if space.dtype == np.uint8 else np.float32


def _node(world: Any, policy: str) -> dict[str, Any]:
    """The node that has the policy in the place of what sent the actions."""
    project, signals = world.described, world.action_signals
    name = signals[0].port.partition(".")[0]
    is_output = any(
        f"{node.name}.{port.name}" == signals[0].port
        for node in project.nodes
        for port in node.outputs
    )
    own = name if is_output else "policy"
    ports: dict[str, dict[str, Port]] = {"inputs": {}, "outputs": {}}
    observation, action = [], []
    for each in world.observation_signals:
        source, _, output = each.port.partition(".")
        here = [
            c.destination_input
            for c in project.connections
            if (c.source_node, c.source_output, c.destination_node) == (source, output, own)
        ]
        port = here[0] if here else output
        ports["inputs"][port] = project.node(source).output(output)
        observation.append(port + each.written.removeprefix(each.port))
    for each in signals:
        node, _, port = each.port.partition(".")
        owner = project.node(node)
        ports["outputs"][port] = owner.output(port) if is_output else owner.input(port)
        action.append(port + each.written.removeprefix(each.port))
    copies = None if not is_output else project.node(name).copies
    return {
        "name": own,
        "container": "neuros_onnx",
        "policy": policy,
        **({} if copies is None else {"copies": copies}),
        **{
            side: [{"name": n, "type": _type(port, copies)} for n, port in found.items()]
            for side, found in ports.items()
        },
        "parameters": {_OBSERVATION: observation, _ACTION: action},
    }


def _type(port: Port, copies: int | None) -> str:
    return port.type if copies is None or port.array is None else str(port.array.of_one_copy)
