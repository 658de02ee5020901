"""The network of ``predictive_coding.py`` in TensorFlow: it computes on a GPU that it is given.

Seeds, files and, but for rounding, results are those of the network in NumPy. The gradients are
not written down here: TensorFlow derives them from the energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import tensorflow as tf
from predictive_coding import (
    CODE_WEIGHT,
    DECAY,
    INFERENCE_STEPS,
    LAYERS,
    LEAK,
    LEARNING_STEPS,
    MOMENTUM,
    START,
    STEP,
    Floats,
    PredictiveCodingNetwork,
)


class TensorFlowNetwork(PredictiveCodingNetwork):
    """A :class:`PredictiveCodingNetwork` whose causes and gradients TensorFlow computes."""

    def __init__(self, pixels: int, codes: int, seed: int) -> None:
        tf.config.experimental.enable_op_determinism()
        # GPUs would round factors to 10 bits, and the weights were others than those of NumPy.
        tf.config.experimental.enable_tensor_float_32_execution(False)
        super().__init__(pixels, codes, seed)

    @property
    def computed_by(self) -> str:
        """The library, and what it computes on."""
        library = f"TensorFlow {tf.__version__}"
        for gpu in tf.config.list_physical_devices("GPU"):  # it computes on the first one
            name = tf.config.experimental.get_device_details(gpu).get("device_name", gpu.name)
            return f"{library} on the GPU ({name})"
        return f"{library} on the processor, since it sees no GPU"

    def _see(self, views: Floats, codes: Floats | None = None, steps: int = INFERENCE_STEPS) -> Any:
        weight = 0.0 if codes is None else CODE_WEIGHT
        if codes is None:
            codes = np.zeros((len(views), self._code.shape[1]), np.float32)
        given = [tf.constant(each) for each in (views, codes, weight, steps)]
        return [views, *(each.numpy() for each in _causes(*given, self._constants()))]

    def _rises(self, views: Floats, codes: Floats) -> tuple[list[Floats], float]:
        rises, error = _rises(tf.constant(views), tf.constant(codes), self._constants())
        return [each.numpy() for each in rises], float(error)

    def _constants(self) -> list[tf.Tensor]:
        return [tf.constant(each) for each in (*self._down, self._code)]


def _energy(
    layers: Sequence[tf.Tensor], codes: tf.Tensor, code_weight: tf.Tensor, weights: list[tf.Tensor]
) -> tf.Tensor:
    """Half the squared errors of all predictions, summed over the views."""
    energy = DECAY * tf.nn.l2_loss(layers[-1])
    energy += code_weight * tf.nn.l2_loss(codes - _predicted(layers[-1], weights[-1]))
    for below, above, each in zip(layers, layers[1:], weights, strict=False):
        energy += tf.nn.l2_loss(below - _predicted(above, each))
    return energy


@tf.function(reduce_retracing=True)
def _causes(
    views: tf.Tensor,
    codes: tf.Tensor,
    code_weight: tf.Tensor,
    steps: tf.Tensor,
    weights: list[tf.Tensor],
) -> list[tf.Tensor]:
    """Descend the energy from causes that are all alike, with momentum."""
    causes = [tf.fill((tf.shape(views)[0], size), START) for size in LAYERS]
    speeds = [tf.zeros_like(cause) for cause in causes]
    for _ in tf.range(steps):
        with tf.GradientTape() as tape:
            tape.watch(causes)
            energy = _energy([views, *causes], codes, code_weight, weights)
        slopes = tape.gradient(energy, causes)
        speeds = [
            MOMENTUM * speed - STEP * slope for speed, slope in zip(speeds, slopes, strict=True)
        ]
        causes = [cause + speed for cause, speed in zip(causes, speeds, strict=True)]
    return causes


@tf.function(reduce_retracing=True)
def _rises(
    views: tf.Tensor, codes: tf.Tensor, weights: list[tf.Tensor]
) -> tuple[list[tf.Tensor], tf.Tensor]:
    code_weight = tf.constant(CODE_WEIGHT)
    causes = _causes(views, codes, code_weight, tf.constant(LEARNING_STEPS), weights)
    with tf.GradientTape() as tape:
        tape.watch(weights)
        energy = _energy([views, *causes], codes, code_weight, weights)
    rises = [-slope for slope in tape.gradient(energy, weights)]
    return rises, tf.reduce_mean(tf.square(views - _predicted(causes[0], weights[0])))


def _predicted(causes: tf.Tensor, weights: tf.Tensor) -> tf.Tensor:
    return tf.nn.leaky_relu(causes, LEAK) @ weights
