"""Datasets for imitation and offline reinforcement learning, from recorded runs.

::

    from pathlib import Path

    import neuros.datasets

    runs = sorted(Path("runs/cartpole").iterdir())
    observation, action = ["cart.joints.position", "cart.joints.velocity"], "policy.force"
    steps = neuros.datasets.steps(runs[0], observation, action)         # NumPy
    neuros.datasets.minari(runs, "cartpole/expert-v0", observation, action)
    neuros.datasets.lerobot(runs, "datasets/cartpole", observation, action, task="balance the pole")

Each run is an episode. Each packet of the first observation begins a step.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

import neuros.bag
from neuros.bag import Bag, RecordedTopic
from neuros.errors import UsageError
from neuros.project.suggest import did_you_mean
from neuros.recording.columns import (
    IMAGE,
    LOG_TIME,
    PUBLISH_TIME,
    Column,
    has_simulated_time,
    library,
    pixels_of,
)

Run: TypeAlias = "str | os.PathLike[str]"
Names: TypeAlias = "str | Sequence[str]"

_NEVER = np.iinfo(np.int64).max
_MOST_JITTER = 0.5  # relative to the time between two steps


@dataclass(frozen=True)
class Steps:
    """The steps of a run, in order.

    Attributes:
        observation: by name, an array with a row per step: the packet that the action answers.
        action: by name, an array with a row per step: the newest packet at the end of the step.
        time_s: start of each step: simulated time, or without it, wall time since the first.
    """

    observation: dict[str, Column]
    action: dict[str, Column]
    time_s: npt.NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.time_s)


def steps(run: Run, observation: Names, action: Names) -> Steps:
    """The observations and actions of a recorded run, step by step.

    A step begins with each packet of the first observation, and ends before the next one. Actions
    are the newest packets that were sent before the step ended. Other observations are the newest
    that were sent before the first action of the step, or before the step began where it has no
    action. The order is that of the recording. Steps before each output has sent, and the last step
    if no action was sent in it, are left out.

    Args:
        run: the run folder, or a rosbag2 folder.
        observation, action: ``node.output``, for all numbers of its messages (without time stamps),
            or ``node.output.field``. An image is an array ``(step, y, x[, channel])``.

    Raises:
        UsageError: there is no such output or field, or it holds no numbers, or arrays of changing
            length; or the run has no steps.
        EnvironmentFault: as :func:`neuros.bag.open`.
    """
    with neuros.bag.open(run) as bag:
        seen = [_Signal(bag, name) for name in _listed(observation)]
        done = [_Signal(bag, name) for name in _listed(action)]
    begins = seen[0].sent_ns
    ends = np.append(begins[1:], _NEVER)
    # Packets that a hook sends together are recorded one after the other, all before the answer.
    answers = np.min([each.first_after(begins) for each in done], axis=0)
    has_answer = answers < ends
    seen_by = np.where(has_answer, answers, begins)
    first = np.arange(len(begins))
    rows = [
        first,
        *(each.before(seen_by) for each in seen[1:]),
        *(each.before(ends - 1) for each in done),
    ]
    is_whole = np.min(rows, axis=0) >= 0
    is_whole[-1:] &= has_answer[-1:]
    if not is_whole.any():
        raise UsageError(f"{os.fspath(run)} has no step in which each output has sent")
    values = {
        each.name: each.values[row[is_whole]] for each, row in zip(seen + done, rows, strict=True)
    }
    return Steps(
        {each.name: values[each.name] for each in seen},
        {each.name: values[each.name] for each in done},
        seen[0].time_s[is_whole],
    )


def minari(
    runs: Run | Sequence[Run],
    dataset_id: str,
    observation: Names,
    action: Names,
    *,
    reward: Callable[[Any, Any], float] = lambda observation, action: 0.0,
    **options: Any,
) -> Any:
    """Write recorded runs as a dataset of Minari, an episode each, and return it.

    The last step's observation ends the episode, which is *truncated*. One name makes
    a ``Box``, a list a ``Dict`` of boxes, as in :mod:`~neuros_learn.gym`. Source of the format: O.
    Younis et al., "Minari", 2024; the library writes it into ``MINARI_DATASETS_PATH``.

    Args:
        dataset_id: ``name-v0``, or ``namespace/name-v0``.
        observation, action: as for :func:`steps`.
        reward: called with the observation at the end of a step, and the step's action.
        options: of ``minari.create_dataset_from_buffers``: ``author``, ``data_format``, ...

    Raises:
        EnvironmentFault: Minari is not installed.
        UsageError: as :func:`steps`; or a run has one step only.
        ValueError: Minari refuses the name.
    """
    library("minari", "steps()")
    from minari import create_dataset_from_buffers
    from minari.data_collector import EpisodeBuffer

    episodes = [steps(run, observation, action) for run in _listed_runs(runs)]
    buffers = []
    for number, found in enumerate(episodes):
        if len(found) < 2:
            raise UsageError(f"{os.fspath(_listed_runs(runs)[number])} has one step only")
        last = len(found) - 1
        seen = _as_asked(found.observation, observation)
        done = _as_asked({key: column[:-1] for key, column in found.action.items()}, action)
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=seen,
                actions=done,
                rewards=[float(reward(_row(seen, n + 1), _row(done, n))) for n in range(last)],
                terminations=[False] * last,
                truncations=[False] * (last - 1) + [True],
                infos={},
            )
        )
    return create_dataset_from_buffers(
        dataset_id,
        buffers,
        observation_space=_space([each.observation for each in episodes], observation),
        action_space=_space([each.action for each in episodes], action),
        **{"jpeg_encoding": False, **options},
    )


def lerobot(
    runs: Run | Sequence[Run],
    folder: Run,
    observation: Names,
    action: Names,
    *,
    task: str,
    fps: int | None = None,
    repo_id: str = "neuros/recorded",
    **options: Any,
) -> Any:
    """Write recorded runs as a dataset of LeRobot, an episode each, and return it.

    The observed numbers are joined as ``observation.state``, the actions as ``action``, both
    float32; an image is ``observation.images.NODE_OUTPUT``. Source of the format: R. Cadene et al.,
    "LeRobot", 2024; the library writes it.

    Args:
        folder: of the dataset; must not exist.
        observation, action: as for :func:`steps`.
        task: the robot's task, in a sentence.
        fps: steps per second; if left out, the rate of the first observation in the first run.
        repo_id: name of the dataset, ``user/name``.
        options: those of ``LeRobotDataset.create``: ``robot_type``, ``use_videos`` (false if left
            out: images are stored without loss), ...

    Raises:
        EnvironmentFault: LeRobot is not installed.
        UsageError: as :func:`steps`; or the folder exists; images do not have 8 bits; or ``fps`` is
            left out and the steps have no steady, whole rate.
    """
    library("lerobot", "steps()")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if os.path.lexists(folder):
        raise UsageError(f"{os.fspath(folder)} exists already")
    episodes = [steps(run, observation, action) for run in _listed_runs(runs)]
    frames = [_lerobot_frames(found) for found in episodes]
    options = {"use_videos": False, **options}
    made = LeRobotDataset.create(
        repo_id,
        fps or _whole_rate(episodes[0]),
        _lerobot_features(frames[0], episodes[0], options["use_videos"]),
        root=folder,
        **options,
    )
    for found, columns in zip(episodes, frames, strict=True):
        for place in range(len(found)):
            made.add_frame({**{key: c[place] for key, c in columns.items()}, "task": task})
        made.save_episode()
    made.finalize()
    return made


class _Signal:
    """Values of an output or of one of its fields, a row per packet."""

    def __init__(self, bag: Bag, name: str) -> None:
        topic, field = _split(bag, name)
        columns = topic.columns()
        self.name = name
        self.sent_ns: npt.NDArray[np.int64] = columns[LOG_TIME]
        if not len(self.sent_ns):
            raise UsageError(f"'{name}': no packets were recorded")
        owns_time = has_simulated_time(columns)
        self.time_s = (
            columns[PUBLISH_TIME] / 1e9 if owns_time else (self.sent_ns - self.sent_ns[:1]) / 1e9
        )
        self.values = _values(topic, columns, name, field)

    def before(self, times_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
        """The index of the newest packet at or before each time; -1 where there is none."""
        return np.searchsorted(self.sent_ns, times_ns, side="right") - 1

    def first_after(self, times_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        sent_ns = np.append(self.sent_ns, _NEVER)
        return sent_ns[np.searchsorted(self.sent_ns, times_ns, side="right")]


def _split(bag: Bag, name: str) -> tuple[RecordedTopic, str]:
    """The topic of ``node.output.field``, and the field."""
    node, _, rest = name.partition(".")
    output, _, field = rest.partition(".")
    try:
        return bag[f"{node}.{output}" if output else name], field
    except KeyError as error:
        raise UsageError(str(error.args[0])) from None


def _values(topic: RecordedTopic, columns: Mapping[str, Column], name: str, field: str) -> Column:
    """The numbers of a topic or field: an image's pixels, else all numeric columns joined."""
    if topic.type == IMAGE and field in ("", "data"):
        pixels = pixels_of(columns, "")
        if pixels is None:
            raise UsageError(f"{name}: the images differ in size, or their pixels are not known")
        is_bgr = len(columns["encoding"]) > 0 and str(columns["encoding"][0]).startswith("bgr")
        return pixels[..., [2, 1, 0, *range(3, pixels.shape[-1])]] if is_bgr else pixels
    fields = {key: c for key, c in columns.items() if key not in (LOG_TIME, PUBLISH_TIME)}
    if field:
        within = (f"{field}.", f"{field}[")
        found = {k: c for k, c in fields.items() if k == field or k.startswith(within)}
        if not found:
            hint = did_you_mean(field, fields) or f"it has {', '.join(fields)}"
            raise UsageError(f"'{name}': {topic.type} has no field '{field}' ({hint})")
    else:
        about = ("stamp.sec", "stamp.nanosec", "layout.dim", "layout.data_offset")
        found = {k: c for k, c in fields.items() if not k.endswith(about)}
    numbers = []
    for key, column in found.items():
        plain = column
        if column.dtype == object and all(isinstance(each, np.ndarray) for each in column):
            if len({each.shape for each in column}) > 1:
                raise UsageError(f"'{name}': {key} changes its length from packet to packet")
            plain = np.stack([*column]) if len(column) else np.empty((0, 0))
        if plain.dtype.kind in "biuf":
            numbers.append(plain.reshape(len(plain), math.prod(plain.shape[1:])))
    if not any(column.shape[1] for column in numbers):
        raise UsageError(f"'{name}' holds no numbers")
    return np.concatenate(numbers, axis=1)


def _listed(names: Names) -> list[str]:
    listed = [names] if isinstance(names, str) else [*names]
    if not listed or len({*listed}) < len(listed):
        raise UsageError("name one output or more, each once" if listed else "name an output")
    return listed


def _listed_runs(runs: Run | Sequence[Run]) -> list[Run]:
    listed = [runs] if isinstance(runs, (str, os.PathLike)) else [*runs]
    if not listed:
        raise UsageError("a dataset needs a run")
    return listed


def _as_asked(columns: dict[str, Column], names: Names) -> Any:
    return columns[names] if isinstance(names, str) else columns


def _row(columns: Any, place: int) -> Any:
    if isinstance(columns, dict):
        return {name: column[place] for name, column in columns.items()}
    return columns[place]


def _space(episodes: Sequence[dict[str, Column]], names: Names) -> Any:
    """The space of recorded values; its bounds are those of their number type."""
    from gymnasium import spaces

    boxes: dict[str, Any] = {}
    for name, column in episodes[0].items():
        kind, shape = column.dtype, column.shape[1:]
        if any(each[name].shape[1:] != shape for each in episodes):
            raise UsageError(f"'{name}' has another length in one of the runs")
        low, high = -np.inf, np.inf
        if kind.kind == "b":
            low, high = 0, 1
        elif kind.kind != "f":
            low, high = int(np.iinfo(kind).min), int(np.iinfo(kind).max)
        boxes[name] = spaces.Box(low, high, shape, kind.type)
    return boxes[names] if isinstance(names, str) else spaces.Dict(boxes)


def _lerobot_frames(found: Steps) -> dict[str, Column]:
    """By feature, an array with a row per step; every image has three colours."""
    frames, numbers = {}, []
    for name, column in found.observation.items():
        if column.ndim == 2:
            numbers.append(column)
            continue
        if column.dtype != np.uint8:
            raise UsageError(f"'{name}': LeRobot takes images of 8 bits, not {column.dtype}")
        colours = column[..., None].repeat(3, axis=-1) if column.ndim == 3 else column[..., :3]
        frames[f"observation.images.{name.removesuffix('.data').replace('.', '_')}"] = colours
    if numbers:
        frames["observation.state"] = np.concatenate(numbers, axis=1).astype(np.float32)
    flat = [column.reshape(len(column), -1) for column in found.action.values()]
    return {**frames, "action": np.concatenate(flat, axis=1).astype(np.float32)}


def _lerobot_features(
    frames: Mapping[str, Column], found: Steps, use_videos: bool
) -> dict[str, Any]:
    features: dict[str, Any] = {}
    for key, column in frames.items():
        shape = column.shape[1:]
        if len(shape) == 3:
            kind = "video" if use_videos else "image"
            features[key] = {"dtype": kind, "shape": shape, "names": ["height", "width", "channel"]}
            continue
        parts = found.action if key == "action" else found.observation
        sizes = {n: c[0].size for n, c in parts.items() if key == "action" or c.ndim == 2}
        names = [
            f"{name}[{place}]" if size > 1 else name
            for name, size in sizes.items()
            for place in range(size)
        ]
        features[key] = {"dtype": "float32", "shape": shape, "names": names}
    return features


def _whole_rate(found: Steps) -> int:
    """Steps per second. Raises ``UsageError`` unless the rate is steady and whole."""
    between_s = np.diff(found.time_s)
    if not len(between_s) or between_s.min() <= 0:
        raise UsageError("the steps have no rate: give fps")
    rate_hz = float(1 / np.median(between_s))
    is_steady = np.max(np.abs(between_s * rate_hz - 1)) <= _MOST_JITTER
    if not is_steady or round(rate_hz) < 1 or abs(rate_hz - round(rate_hz)) > 0.02 * rate_hz:
        raise UsageError(
            f"the steps have no steady, whole rate (median {rate_hz:.4g} per second, from"
            f" {1 / between_s.max():.4g} to {1 / between_s.min():.4g}): give fps"
        )
    return round(rate_hz)
