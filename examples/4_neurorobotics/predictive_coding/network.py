"""A predictive coding network in TensorFlow: it learns what it sees, and where it looks.

Every layer predicts the one below it, and is corrected by how far its prediction is off::

    image (900) <- causes (192) <- causes (96) <- causes (48) -> heading code (180)

A generative model: *causes* ``c`` are inferred for each image by descending the energy, the sum of
squared errors of all predictions ``f(c) W``; then the weights descend the same energy at these
causes, with rates after Adam. Both rules are local: a weight changes by the error it predicts into,
times the cause it predicts from. While it learns the heading is given, and is predicted like the
image; afterwards the causes are inferred from the image alone, and the heading is read off what the
uppermost ones predict.

Rao & Ballard, *Nature Neuroscience* 2, 79 (1999); Dora, Pennartz & Bohte, ICANN (2018); for place
and heading of a robot Struckmeier et al., arXiv:1909.07201 (2019). Written anew, and smaller.
No ROS and no NeuROS in here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import tensorflow as tf
from numpy.typing import NDArray

Floats = NDArray[np.float32]

LAYERS = (192, 96, 48)
LEAK = 0.2  # slope of the leaky ReLU below 0
STEP, MOMENTUM = 0.08, 0.8  # of inference
DECAY = 0.01  # pulls the uppermost causes to 0
START = 0.1  # causes before inference
CODE_WEIGHT = 0.3  # of the heading's error against the image's, while learning
LEARNING_STEPS, INFERENCE_STEPS = 30, 60
BATCH = 24
LEARNING_RATES = (2e-3, 2e-4)  # first and last epoch, geometric in between


class PredictiveCodingNetwork:
    """Learns pairs of image and code, and then infers the code of an image.

    Args:
        pixels: values per image.
        codes: values per code.
        seed: of the first weights and of the order in which examples are learnt.
    """

    def __init__(self, pixels: int, codes: int, seed: int) -> None:
        tf.config.experimental.enable_op_determinism()
        self._rng = np.random.default_rng(seed)
        sizes = (pixels, *LAYERS)
        self._down = [self._weights(*pair) for pair in zip(sizes[1:], sizes, strict=False)]
        self._code = self._weights(LAYERS[-1], codes)
        self._optimiser = tf.keras.optimizers.Adam(LEARNING_RATES[0])
        self._optimiser.build([*self._down, self._code])

    def learn(self, images: Floats, codes: Floats, epochs: int) -> list[float]:
        """Learn ``(n, pixels)`` and ``(n, codes)``; mean squared error of the images, by epoch."""
        first, last = LEARNING_RATES
        errors = []
        for epoch in range(epochs):
            share = epoch / max(1, epochs - 1)
            self._optimiser.learning_rate = first * (last / first) ** share
            order = self._rng.permutation(len(images))
            # Whole batches only: what is left out is another part in every epoch.
            batches = [order[i : i + BATCH] for i in range(0, len(order) - BATCH + 1, BATCH)]
            found = [float(self._learn_batch(images[some], codes[some])) for some in batches]
            errors.append(float(np.mean(found)))
        self._learn_to_read(images, codes)
        return errors

    def infer(self, images: Floats) -> tuple[Floats, float]:
        """Codes ``(n, codes)`` of images ``(n, pixels)``, and the mean squared error of the images.

        The error says how well the network knows what it sees: it is large for what it never saw.
        """
        codes, error = self._infer(images)
        return codes.numpy(), float(error)

    def _weights(self, causes: int, predicted: int) -> tf.Variable:
        drawn = self._rng.normal(0.0, 1.0 / np.sqrt(causes), (causes, predicted))
        return tf.Variable(drawn.astype(np.float32))

    def _energy(
        self, causes: Sequence[tf.Tensor], images: tf.Tensor, codes: tf.Tensor, weight: float
    ) -> tf.Tensor:
        """Half the squared errors of all predictions, summed over the batch."""
        energy = DECAY * tf.nn.l2_loss(causes[-1])
        for below, above, weights in zip((images, *causes), causes, self._down, strict=False):
            energy += tf.nn.l2_loss(below - _predicted(above, weights))
        return energy + weight * tf.nn.l2_loss(codes - _predicted(causes[-1], self._code))

    def _causes(
        self, images: tf.Tensor, codes: tf.Tensor, weight: float, steps: int
    ) -> list[tf.Tensor]:
        """Descend the energy from causes that are all alike, with momentum."""
        shape = tf.shape(images)[0]
        causes = [tf.fill((shape, size), START) for size in LAYERS]
        speeds = [tf.zeros_like(cause) for cause in causes]
        for _ in tf.range(steps):
            with tf.GradientTape() as tape:
                tape.watch(causes)
                energy = self._energy(causes, images, codes, weight)
            slopes = tape.gradient(energy, causes)
            speeds = [
                MOMENTUM * speed - STEP * slope for speed, slope in zip(speeds, slopes, strict=True)
            ]
            causes = [cause + speed for cause, speed in zip(causes, speeds, strict=True)]
        return causes

    @tf.function
    def _learn_batch(self, images: tf.Tensor, codes: tf.Tensor) -> tf.Tensor:
        causes = self._causes(images, codes, CODE_WEIGHT, LEARNING_STEPS)
        weights = [*self._down, self._code]
        with tf.GradientTape() as tape:
            energy = self._energy(causes, images, codes, CODE_WEIGHT)
        self._optimiser.apply_gradients(zip(tape.gradient(energy, weights), weights, strict=True))
        return tf.reduce_mean(tf.square(images - _predicted(causes[0], self._down[0])))

    def _learn_to_read(self, images: Floats, codes: Floats) -> None:
        """Let the code be predicted from the causes that the image alone brings about."""
        nothing = tf.zeros_like(codes)
        causes = self._see(images, nothing)
        optimiser = tf.keras.optimizers.Adam(LEARNING_RATES[0])
        optimiser.build([self._code])
        for _ in range(400):
            self._read_step(optimiser, causes, codes)

    @tf.function
    def _see(self, images: tf.Tensor, codes: tf.Tensor) -> tf.Tensor:
        return self._causes(images, codes, 0.0, INFERENCE_STEPS)[-1]

    @tf.function
    def _read_step(
        self, optimiser: tf.keras.optimizers.Optimizer, causes: tf.Tensor, codes: tf.Tensor
    ) -> None:
        with tf.GradientTape() as tape:
            error = tf.nn.l2_loss(codes - _predicted(causes, self._code))
        optimiser.apply_gradients([(tape.gradient(error, self._code), self._code)])

    @tf.function
    def _infer(self, images: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:
        codes = tf.zeros((tf.shape(images)[0], self._code.shape[1]))
        causes = self._causes(images, codes, 0.0, INFERENCE_STEPS)
        error = tf.reduce_mean(tf.square(images - _predicted(causes[0], self._down[0])))
        return _predicted(causes[-1], self._code), error


def _predicted(causes: tf.Tensor, weights: tf.Variable) -> tf.Tensor:
    return tf.nn.leaky_relu(causes, LEAK) @ weights
