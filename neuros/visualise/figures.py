"""Figures that plugins make and feed; their process draws, so Matplotlib is not imported here."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from neuros.errors import EnvironmentFault
from neuros.visualise.feed import Feed, is_drawn

_LARGEST_SIDE = 320
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}
_LONGEST_STEM = 60  # characters, of up to four bytes: a name may have 255


class _Figure:
    """Common part of all figures.

    Args:
        title: of the figure; its file is named after it, with a number where that is taken.
        duration: how many seconds are shown, the latest ones; ``None``: all.
        below: another figure, whose window and file this one shares, underneath.
        save_every: seconds of wall time between two times that it is saved.

    Attributes:
        file: where the figure is saved.

    Raises:
        EnvironmentFault: if Matplotlib is not installed.
    """

    _KIND = ""

    def __init__(
        self,
        title: str,
        duration: float | None = 60,
        *,
        below: _Figure | None = None,
        save_every: float = 10.0,
        **options: Any,
    ) -> None:
        self._names: set[str] = set()
        if below is None:
            if find_spec("matplotlib") is None:
                raise EnvironmentFault("figures need Matplotlib: pip install 'neuros[plot]'")
            self.file = _file_for(title)
            self._feed = Feed(("figure", title, str(self.file), float(save_every)), self.file)
            self._panels = [self]
        else:
            self.file, self._feed, self._panels = below.file, below._feed, below._panels
            self._panels.append(self)
        self._number = len(self._panels) - 1
        options |= {"title": title, "duration": duration}
        self._feed.send(("panel", self._number, self._KIND, options))

    @property
    def dropped(self) -> int:
        """Updates that were not drawn, since the drawing process had too many to draw."""
        return self._feed.dropped

    def caption(self, text: str) -> None:
        """Write a line above this part of the figure."""
        self._feed.send(("caption", self._number, text))

    def close(self) -> None:
        """Save the figure and close its window; happens by itself when the node ends."""
        self._feed.close()

    def _add(self, name: str, colour: str | None, **options: Any) -> None:
        self._names.add(name)
        self._feed.send(("series", self._number, name, {"colour": colour, **options}))

    def _send(self, name: str, *values: Any) -> None:
        self._check(name)
        self._feed.send(("data", self._number, name, *values))

    def _check(self, name: str) -> None:
        if name not in self._names:
            known = ", ".join(sorted(self._names)) or "none"
            raise ValueError(f"'{name}' was not added to the figure; there are {known}")


class VisualiseLines(_Figure):
    """Numbers over time.

    Args:
        title, duration, below, save_every: see :class:`VisualiseRotations`.
        y_label: of the vertical axis.
    """

    _KIND = "lines"

    def __init__(
        self,
        title: str,
        duration: float | None = 60,
        *,
        y_label: str = "",
        below: _Figure | None = None,
        save_every: float = 10.0,
    ) -> None:
        super().__init__(title, duration, below=below, save_every=save_every, y_label=y_label)

    def add_line(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line; ``colour`` and ``style`` are Matplotlib's."""
        self._add(name, colour, style=style)

    def plot(self, name: str, value: float, timestamp: float) -> None:
        """Add a point; ``timestamp`` in seconds."""
        self._send(name, float(timestamp), float(value))


class VisualiseRotations(_Figure):
    """Angles over time, in radians. Where one passes half a turn its line is broken, not drawn
    across the figure.

    Args:
        title: of the figure; its file is named after it.
        duration: how many seconds are shown, the latest ones; ``None``: all.
        below: another figure, whose window and file this one shares, underneath.
        save_every: seconds of wall time between two times that it is saved.

    Raises:
        EnvironmentFault: if Matplotlib is not installed.
    """

    _KIND = "angles"

    def __init__(
        self,
        title: str,
        duration: float | None = 60,
        *,
        below: _Figure | None = None,
        save_every: float = 10.0,
    ) -> None:
        super().__init__(title, duration, below=below, save_every=save_every)
        self._kinds: dict[str, str] = {}

    def add_quaternion(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line fed with orientations, whose rotation about the vertical is shown."""
        self._kinds[name] = "quaternion"
        self._add(name, colour, style=style)

    def add_degrees(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line fed with angles in degrees."""
        self._kinds[name] = "degrees"
        self._add(name, colour, style=style)

    def add_radians(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line fed with angles in radians."""
        self._kinds[name] = "radians"
        self._add(name, colour, style=style)

    def plot(self, line_name: str, orientation: Any, timestamp: float) -> None:
        """Add a point.

        Args:
            line_name: which line.
            orientation: a quaternion with ``x``, ``y``, ``z``, ``w``, or an angle, as the line has
                it.
            timestamp: in seconds.
        """
        self._check(line_name)
        kind = self._kinds[line_name]
        if kind == "quaternion":
            angle_rad = _yaw_of(orientation)
        else:
            angle_rad = math.radians(orientation) if kind == "degrees" else float(orientation)
        self._send(line_name, float(timestamp), _wrapped(angle_rad))


class VisualiseImages(_Figure):
    """Images side by side, each the latest one. Large ones are drawn with every n-th pixel."""

    _KIND = "images"

    def __init__(
        self, title: str, *, below: _Figure | None = None, save_every: float = 10.0
    ) -> None:
        super().__init__(title, None, below=below, save_every=save_every)

    def add_image(self, name: str) -> None:
        """Add a place for an image."""
        self._add(name, None)

    def plot(self, name: str, image: Any, timestamp: float | None = None) -> None:
        """Show an image.

        Args:
            name: where.
            image: ``sensor_msgs/msg/Image`` with encoding ``rgb8``, ``bgr8`` or ``mono8``, or an
                array ``(height, width)`` or ``(height, width, 3)``.
            timestamp: in seconds, for the caption.

        Raises:
            ValueError: for another encoding or shape.
        """
        self._check(name)
        message = ("data", self._number, name, timestamp, _small_pixels(image))
        self._feed.send_latest(f"{self._number} {name}", message)


class VisualiseSpikes(_Figure):
    """Spikes of populations of neurons: a point for each, neuron against time.

    Args:
        title, duration, below, save_every: see :class:`VisualiseRotations`.
    """

    _KIND = "spikes"

    def add_population(self, name: str, size: int, colour: str | None = None) -> None:
        """Add ``size`` neurons, above those that were added before."""
        self._add(name, colour, size=int(size))

    def plot(self, name: str, neurons: Any, timestamp: Any) -> None:
        """Add spikes.

        Args:
            name: of the population.
            neurons: which, from 0, ``(n,)``.
            timestamp: when, in seconds: one time for all, or ``(n,)``.
        """
        which = np.atleast_1d(np.asarray(neurons, np.int64))
        times = np.broadcast_to(np.asarray(timestamp, np.float64), which.shape)
        self._send(name, np.array(times), which)


class VisualiseRing(_Figure):
    """The activity of rings of neurons, such as a ring attractor: around the circle now, and over
    time, with the direction that it stands for (population vector).

    Args:
        title, duration, below, save_every: see :class:`VisualiseRotations`.
    """

    _KIND = "ring"

    def add_ring(self, name: str, colour: str | None = None) -> None:
        """Add a ring. Neuron ``i`` of ``n`` prefers the direction ``2 pi (i + 1/2) / n``."""
        self._add(name, colour)

    def plot(self, name: str, activity: Sequence[float] | Any, timestamp: float) -> None:
        """Add the activity of all its neurons, ``(n,)``, at a time in seconds."""
        self._send(name, float(timestamp), np.asarray(activity, np.float64).ravel())


def _file_for(title: str) -> Path:
    """A file in which no other figure of this process is saved."""
    folder = Path(os.environ.get("NEUROS_RUN_DIR") or ".").absolute()
    stem = re.sub(r"[\W_]+", "_", title).strip("_").lower()[:_LONGEST_STEM] or "figure"
    numbered = (f"{stem}_{number}" for number in itertools.count(2))
    names = itertools.chain([stem], numbered)
    return next(file for name in names if not is_drawn(file := folder / f"{name}.png"))


def _small_pixels(image: Any) -> Any:
    """Every n-th pixel of a ``sensor_msgs/msg/Image`` or array; red comes first.

    Raises:
        ValueError: for an encoding or shape that cannot be drawn.
    """
    pixels = _pixels(image)
    step = max(1, math.ceil(max(pixels.shape[:2]) / _LARGEST_SIDE))
    return np.ascontiguousarray(pixels[::step, ::step])


def _pixels(image: Any) -> Any:
    encoding = getattr(image, "encoding", None)
    if encoding is None:
        pixels = np.asarray(image)
        if pixels.size and (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)):
            return pixels
        raise ValueError(
            f"an image has shape (height, width) or (height, width, 3): {pixels.shape}"
        )
    if encoding not in _CHANNELS:
        raise ValueError(f"images with encoding {encoding} cannot be drawn: rgb8, bgr8, mono8 can")
    channels, height, width = _CHANNELS[encoding], image.height, image.width
    data = np.frombuffer(image.data, np.uint8)
    step = image.step or width * channels
    if not (width and height) or step < width * channels or len(data) < step * height:
        raise ValueError(f"{len(data)} bytes are no image of {width} x {height}, {step} per row")
    rows = data[: step * height].reshape(height, step)
    if encoding == "mono8":
        return rows[:, :width]
    pixels = rows[:, : channels * width].reshape(height, width, channels)
    return pixels if encoding == "rgb8" else pixels[..., ::-1]


def _yaw_of(orientation: Any) -> float:
    """Rotation about the vertical in radians, (-pi, pi], of a unit quaternion.

    ``orientation``: anything with ``x``, ``y``, ``z``, ``w``, such as
    ``geometry_msgs/msg/Quaternion``.
    """
    q = orientation
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _wrapped(angle_rad: float) -> float:
    """An angle in (-pi, pi]."""
    remainder = math.remainder(angle_rad, math.tau)
    return math.pi if remainder == -math.pi else remainder
