"""Figures for plugins: fed by hooks, drawn by a separate process.

::

    from neuros.visualise import VisualiseRotations

    @neuros_initialise()
    def start(node):
        figure = VisualiseRotations("Head direction", node=node)
        figure.add_quaternion("truth", "g")
        figure.add_degrees("estimate", "r")
        node.set_user_data(figure)

    @neuros_function(inputs="pose")
    def show(node, pose):
        node.get_user_data().plot("truth", pose.pose.orientation, stamp_s(pose))

A hook never waits for Matplotlib, which is not imported here: messages go into a socket without
blocking, and wait where it is full. Beyond 4 MiB of waiting messages further ones are left out and
counted. With a display there is a window; in any case the figure is saved in the node's folder of
the run, every ten seconds and at the end. The end of a node waits for figures that know their
``node``, on a busy machine, too.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import math
import os
import pickle
import re
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from neuros.distribution import python_command
from neuros.errors import EnvironmentFault

__all__ = [
    "VisualiseImages",
    "VisualiseLines",
    "VisualiseRing",
    "VisualiseRotations",
    "VisualiseSpikes",
    "image_pixels",
]

_LARGEST_SIDE = 320
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}
_LONGEST_STEM = 60  # characters, of up to four bytes: a file name may have 255 bytes
_MOST_UNSENT_BYTES = 1 << 22
_NICENESS = 5
_PATIENCE_S = 60.0
_PROGRESS_S = 1.0
# A process has 5 s to end, also on a busy machine, and leaves ROS meanwhile.
_PATIENCE_AT_END_S = 2.0
_LENGTH = struct.Struct("!I")
# The program needs no ROS: ros-wheels must not restart it to find ROS's libraries.
_ENVIRONMENT = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}


class _Node(Protocol):
    """The part of the hooks' ``node`` that figures need."""

    def on_close(self, callback: Callable[[], None]) -> None: ...

    def progress(self, text: str) -> None: ...


class _Feed:
    """The drawing process of one figure, and the socket to it.

    Args:
        first: the first message.
        file: the figure's file.
        node: its end closes the figure; ``None``: the end of the process does.

    Attributes:
        dropped: number of messages that were left out.

    Raises:
        EnvironmentFault: the process cannot be started.
    """

    def __init__(self, first: Sequence[Any], file: Path, node: _Node | None) -> None:
        self.file = file
        self._node = node
        self.dropped = 0
        self._sent = 0
        self._unsent = bytearray()
        self._latest: dict[str, Sequence[Any]] = {}
        self._is_gone = False
        self._socket, far_end = socket.socketpair()
        self._socket.setblocking(False)
        try:
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                python_command("neuros.visualise.program"),
                stdin=far_end.fileno(),
                env={**os.environ, **_ENVIRONMENT},
            )
        except OSError as error:
            self._socket.close()
            raise EnvironmentFault(f"the drawing process cannot be started: {error}") from error
        finally:
            far_end.close()
        with contextlib.suppress(OSError):  # drawing must not slow the node down
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)
        _OPEN.append(self)
        if node is not None:
            node.on_close(self.close)
        self.send(first)

    def send(self, message: Sequence[Any]) -> None:
        """Send a message to be drawn, or drop it while too much is unsent."""
        self._flush()
        if self._is_gone or len(self._unsent) > _MOST_UNSENT_BYTES:
            self.dropped += 1
            return
        self._add(message)
        self._flush()

    def send_latest(self, name: str, message: Sequence[Any]) -> None:
        """Send a message in place of an unsent one of the same name."""
        self.dropped += self._is_gone or name in self._latest
        self._latest[name] = message
        self._flush()

    def close(self) -> None:
        """Let the process draw the rest, save and end, and wait for that; idempotent."""
        _close([self], _PATIENCE_S)

    def send_rest(self, deadline_s: float) -> None:
        """Send all waiting messages, and end the stream."""
        while self._has_more and time.monotonic() < deadline_s:
            select.select([], [self._socket], [], _PROGRESS_S)
            self._flush()
            self._report_progress()
        self._socket.close()

    def wait(self, deadline_s: float) -> None:
        """Wait for the end of the process; kill it at the deadline."""
        while self._process.poll() is None:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                self._process.kill()  # waiting for its end takes time, too, on a busy machine
                print(
                    "a figure could not be drawn in time, and was not saved at the end",
                    file=sys.stderr,
                )
                break
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(min(left_s, _PROGRESS_S))
            self._report_progress()
        if self.dropped:
            count = self.dropped + self._sent
            print(f"{self.dropped} of {count} updates were not drawn", file=sys.stderr)

    def _report_progress(self) -> None:
        """Keep the supervisor from ending the node while it waits for the drawing process."""
        if self._node is not None:
            self._node.progress("")

    @property
    def _has_more(self) -> bool:
        return not self._is_gone and bool(self._unsent or self._latest)

    def _add(self, message: Sequence[Any]) -> None:
        data = pickle.dumps(tuple(message), pickle.HIGHEST_PROTOCOL)
        self._unsent += _LENGTH.pack(len(data)) + data
        self._sent += 1

    def _flush(self) -> None:
        try:
            while self._has_more:
                if not self._unsent:
                    self._add(self._latest.pop(next(iter(self._latest))))
                sent = self._socket.send(self._unsent, socket.MSG_NOSIGNAL)
                del self._unsent[:sent]
        except BlockingIOError:
            return
        except OSError:  # the process has ended, and has printed why
            self._is_gone = True


_OPEN: list[_Feed] = []


def _close(feeds: Sequence[_Feed], patience_s: float) -> None:
    deadline_s = time.monotonic() + patience_s
    closing = [feed for feed in feeds if feed in _OPEN]
    for feed in closing:
        _OPEN.remove(feed)
        feed.send_rest(deadline_s)
    for feed in closing:
        feed.wait(deadline_s)


@atexit.register
def _close_all() -> None:
    """Save the figures before the process ends."""
    _close(tuple(_OPEN), _PATIENCE_AT_END_S)


class _Figure:
    """Common part of all figures; :class:`VisualiseRotations` describes the arguments.

    Attributes:
        file: the figure's file.
    """

    _KIND = ""

    def __init__(
        self,
        title: str,
        duration: float | None = 60,
        *,
        below: _Figure | None = None,
        save_every: float = 10.0,
        node: _Node | None = None,
        **options: Any,
    ) -> None:
        self._kinds: dict[str, str] = {}
        if below is None:
            if find_spec("matplotlib") is None:
                raise EnvironmentFault("figures need Matplotlib: pip install 'neuros[plot]'")
            self.file = _file_for(title)
            first = ("figure", title, str(self.file), float(save_every))
            self._feed = _Feed(first, self.file, node)
            self._panels = [self]
        else:
            self.file, self._feed, self._panels = below.file, below._feed, below._panels
            self._panels.append(self)
        self._number = len(self._panels) - 1
        options |= {"title": title, "duration": duration}
        self._feed.send(("panel", self._number, self._KIND, options))

    @property
    def dropped(self) -> int:
        """Number of updates that were not drawn, since the drawing process was too slow."""
        return self._feed.dropped

    def caption(self, text: str) -> None:
        """Write a line above this part of the figure."""
        self._feed.send(("caption", self._number, text))

    def close(self) -> None:
        """Save the figure and close its window; the end of the node does so, too."""
        self._feed.close()

    def _add(self, name: str, colour: str | None, kind: str = "", **options: Any) -> None:
        self._kinds[name] = kind
        self._feed.send(("series", self._number, name, {"colour": colour, **options}))

    def _send(self, name: str, *values: Any) -> None:
        self._check(name)
        self._feed.send(("data", self._number, name, *values))

    def _check(self, name: str) -> None:
        if name not in self._kinds:
            known = ", ".join(sorted(self._kinds)) or "none"
            raise ValueError(f"'{name}' was not added to the figure; there are {known}")


class VisualiseLines(_Figure):
    """Numbers over time.

    Args:
        title, duration, below, save_every, node: see :class:`VisualiseRotations`.
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
        node: _Node | None = None,
    ) -> None:
        super().__init__(
            title, duration, below=below, save_every=save_every, node=node, y_label=y_label
        )

    def add_line(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line; ``colour`` and ``style`` are Matplotlib's."""
        self._add(name, colour, style=style)

    def plot(self, name: str, value: float, timestamp: float) -> None:
        """Add a point; ``timestamp`` in seconds."""
        self._send(name, float(timestamp), float(value))


class VisualiseRotations(_Figure):
    """Angles over time, in radians. A line is broken where its angle passes half a turn.

    Args:
        title: of the figure; its file is named after it, with a number if that name is taken.
        duration: seconds to show, the latest ones; ``None``: all.
        below: another figure, whose window and file this one shares, underneath.
        save_every: seconds of wall time between two saves.
        node: the ``node`` of the hook. Its end waits up to a minute until the figure is saved, and
            two seconds where it is not given.

    Raises:
        EnvironmentFault: if Matplotlib is not installed.
    """

    _KIND = "angles"

    def add_quaternion(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line fed with orientations, whose rotation about the vertical is shown."""
        self._add(name, colour, "quaternion", style=style)

    def add_degrees(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line fed with angles in degrees."""
        self._add(name, colour, "degrees", style=style)

    def add_radians(self, name: str, colour: str | None = None, style: str = "-") -> None:
        """Add a line fed with angles in radians."""
        self._add(name, colour, "radians", style=style)

    def plot(self, line_name: str, orientation: Any, timestamp: float) -> None:
        """Add a point.

        Args:
            line_name: which line.
            orientation: a quaternion with ``x``, ``y``, ``z``, ``w``, or an angle, as the line
                was added.
            timestamp: in seconds.
        """
        self._check(line_name)
        kind = self._kinds[line_name]
        if kind == "quaternion":
            q = orientation
            yaw = (2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
            angle_rad = math.atan2(*yaw)
        else:
            angle_rad = math.radians(orientation) if kind == "degrees" else float(orientation)
        wrapped = math.remainder(angle_rad, math.tau)
        self._send(line_name, float(timestamp), math.pi if wrapped == -math.pi else wrapped)


class VisualiseImages(_Figure):
    """The latest image of each name, side by side. Large ones are drawn with every n-th pixel."""

    _KIND = "images"

    def __init__(
        self,
        title: str,
        *,
        below: _Figure | None = None,
        save_every: float = 10.0,
        node: _Node | None = None,
    ) -> None:
        super().__init__(title, None, below=below, save_every=save_every, node=node)

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
        pixels = image_pixels(image)
        step = max(1, math.ceil(max(pixels.shape[:2]) / _LARGEST_SIDE))
        small = np.ascontiguousarray(pixels[::step, ::step])
        message = ("data", self._number, name, timestamp, small)
        self._feed.send_latest(f"{self._number} {name}", message)


class VisualiseSpikes(_Figure):
    """Spikes of populations of neurons: a point for each, neuron against time.

    Args:
        title, duration, below, save_every, node: see :class:`VisualiseRotations`.
    """

    _KIND = "spikes"

    def add_population(self, name: str, size: int, colour: str | None = None) -> None:
        """Add ``size`` neurons above those of earlier populations."""
        self._add(name, colour, size=int(size))

    def plot(self, name: str, neurons: Any, timestamp: Any) -> None:
        """Add spikes.

        Args:
            name: of the population.
            neurons: indices of the neurons that fired, from 0, ``(n,)``.
            timestamp: in seconds: one time for all, or ``(n,)``.
        """
        which = np.atleast_1d(np.asarray(neurons, np.int64))
        times = np.broadcast_to(np.asarray(timestamp, np.float64), which.shape)
        self._send(name, np.array(times), which)


class VisualiseRing(_Figure):
    """Activity of rings of neurons, such as a ring attractor: around the circle now, and over time,
    with the direction of the population vector.

    Args:
        title, duration, below, save_every, node: see :class:`VisualiseRotations`.
    """

    _KIND = "ring"

    def add_ring(self, name: str, colour: str | None = None) -> None:
        """Add a ring. Neuron ``i`` of ``n`` prefers the direction ``2 pi (i + 1/2) / n``."""
        self._add(name, colour)

    def plot(self, name: str, activity: Sequence[float] | Any, timestamp: float) -> None:
        """Add the activity of all neurons, ``(n,)``, at a time in seconds."""
        self._send(name, float(timestamp), np.asarray(activity, np.float64).ravel())


def _file_for(title: str) -> Path:
    """A file in which no other figure of this process is saved."""
    folder = Path(os.environ.get("NEUROS_RUN_DIR") or ".").absolute()
    stem = re.sub(r"[\W_]+", "_", title).strip("_").lower()[:_LONGEST_STEM] or "figure"
    names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
    taken = {feed.file for feed in _OPEN}
    return next(file for name in names if (file := folder / f"{name}.png") not in taken)


def image_pixels(image: Any) -> Any:
    """The pixels of a ``sensor_msgs/msg/Image`` or array, red first.

    Returns:
        An array ``(height, width)`` or ``(height, width, 3)``; it may share the message's memory.

    Raises:
        ValueError: for an encoding or shape that cannot be drawn.
    """
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
        raise ValueError(
            f"{len(data)} bytes are not an image of {width} x {height}, {step} per row"
        )
    rows = data[: step * height].reshape(height, step)
    if encoding == "mono8":
        return rows[:, :width]
    pixels = rows[:, : channels * width].reshape(height, width, channels)
    return pixels if encoding == "rgb8" else pixels[..., ::-1]
