"""Policies of LeRobot, by that library: R. Cadene et al., "LeRobot", 2024.

Observed numbers are ``observation.state``, an image is one of ``observation.images``, and actions
are ``action``, as in the datasets that ``neuros.datasets.lerobot`` writes. The library and
PyTorch are imported when a policy is opened. Source of the calls: lerobot 0.4.4,
``lerobot/policies/factory.py`` and ``lerobot/utils/control_utils.py``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neuros_learn.policies.model import Model, PolicyError, Tensor, Values

CONFIG = "config.json"
_IMAGE = "VISUAL"


def features(config: Mapping[str, Any], side: str) -> dict[str, Tensor]:
    """The inputs or outputs in the ``config.json`` of a policy; raises :class:`PolicyError`.

    An image has the shape (height, width, colour), as in messages, and 8 bits.
    """
    try:
        found = {}
        for name, feature in config[f"{side}_features"].items():
            shape = tuple(map(int, feature["shape"]))
            is_image = feature["type"] == _IMAGE
            sizes = (*shape[1:], shape[0]) if is_image else shape
            found[name] = Tensor(name, sizes, "uint8" if is_image else "float32")
        return found
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"its {CONFIG} has no {side}_features of LeRobot ({error})") from None


class LeRobotModel(Model):
    """A policy of LeRobot on the processor.

    Args:
        place: its folder, or the name of its repository.
        task: in a sentence, for policies that are given one.
    """

    def __init__(self, place: str, task: str) -> None:
        try:
            import torch
            from lerobot.configs.policies import PreTrainedConfig
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        except ImportError as error:
            text = "policies of LeRobot need its library, which is not installed"
            raise PolicyError(text, f"pip install lerobot ({error})") from None
        self._torch, self._task = torch, task
        torch.set_num_threads(1)
        try:
            config = PreTrainedConfig.from_pretrained(place)
            config.device = "cpu"
            self._policy = get_policy_class(config.type).from_pretrained(place, config=config)
            self._before, self._after = make_pre_post_processors(config, pretrained_path=place)
        except Exception as error:  # the library raises anything
            lines = str(error).splitlines() or [type(error).__name__]
            raise PolicyError(f"LeRobot cannot open '{place}': {lines[0]}") from None
        described = {
            f"{side}_features": {
                name: {"type": _type_of(feature), "shape": feature.shape}
                for name, feature in getattr(config, f"{side}_features").items()
            }
            for side in ("input", "output")
        }
        self.inputs, self.outputs = features(described, "input"), features(described, "output")
        self.sha256 = _digest(Path(place))
        self.reset()

    def reset(self) -> None:
        self._policy.reset()

    def run(self, values: Values) -> Values:
        torch, batch = self._torch, {}
        for name, value in values.items():
            tensor = torch.from_numpy(np.ascontiguousarray(value))
            if value.dtype == np.uint8:  # an image: colours from 0 to 1, before the other axes
                tensor = tensor.type(torch.float32).permute(2, 0, 1) / 255
            batch[name] = tensor.unsqueeze(0)
        batch["task"] = self._task
        with torch.inference_mode():
            action = self._after(self._policy.select_action(self._before(batch)))
        (name,) = self.outputs
        return {name: action.numpy()}


def read_config(folder: Path) -> Mapping[str, Any]:
    """The ``config.json`` of a policy; raises :class:`PolicyError`."""
    try:
        found: Mapping[str, Any] = json.loads((folder / CONFIG).read_bytes())
    except (OSError, ValueError) as error:
        raise PolicyError(f"{folder / CONFIG} cannot be read: {error}") from None
    return found


def _type_of(feature: Any) -> str:
    kind = feature.type
    return str(getattr(kind, "value", kind))


def _digest(folder: Path) -> str:
    """The SHA-256 of the names and contents of all files; of a repository, none."""
    whole = hashlib.sha256()
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in files:
        whole.update(f"{path.relative_to(folder)}\0".encode())
        whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest() if files else ""
