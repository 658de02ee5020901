"""A step of an environment: the half-cheetah as a project, against a bare environment.

All step the model of Gymnasium by five timesteps of 10 ms (``frame_skip``), with equal actions. The
bare one does what Gymnasium's ``MujocoEnv`` does. The one by hand calls the hooks of the project
with their messages, one after the other: no engine and no session could be faster than that.
"""

from __future__ import annotations

import contextlib
import functools
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

import neuros.gym
from benchmarks.launching import project_of_plugins
from benchmarks.measure import Case, Figure, Group, Subject
from benchmarks.plugins import cheetah
from neuros.testing import PluginHarness

NEUROS, BY_HAND, BARE = "in process", "by hand", "a bare environment"
FRAME_SKIP = 5
MODEL = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "half_cheetah.xml"
JOINTS = ("rootx", "rootz", "rooty", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
MOTORS = JOINTS[3:]
_PARTS = ("position", "velocity")
EPISODE, RESETS = 1000, 10
US = 1e6


def subject(is_quick: bool) -> Subject:
    """Two episodes per round, and some resets."""
    steps = EPISODE if is_quick else 2 * EPISODE
    candidates = {
        NEUROS: functools.partial(times_of_neuros, steps),
        BY_HAND: functools.partial(times_by_hand, steps),
        BARE: functools.partial(times, Bare, steps),
    }
    cases = tuple(
        Case(name, "us", Figure(candidate, figure), Figure(BARE, figure), BARE)
        for name, candidate, figure in (
            ("a step of a cheetah, in process", NEUROS, "step"),
            ("its hooks and messages by hand", BY_HAND, "step"),
            ("its reset", NEUROS, "reset"),
        )
    )
    return Subject(
        "a step of an environment for learning, as a project and bare",
        (Group(candidates, cases),),
    )


class Bare(gymnasium.Env[Any, Any]):
    """The model in MuJoCo, and nothing besides."""

    def __init__(self) -> None:
        self._model = mujoco.MjModel.from_xml_path(str(MODEL))
        self._data = mujoco.MjData(self._model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._data.ctrl[:] = action
        mujoco.mj_step(self._model, self._data, nstep=FRAME_SKIP)
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> Any:
        return np.concatenate([self._data.qpos, self._data.qvel])


class ByHand(gymnasium.Env[Any, Any]):
    """The node of the project without an engine: its hooks, called with messages.

    Args:
        harness: gives its ``node`` to the hooks.
    """

    def __init__(self, harness: PluginHarness) -> None:
        self._harness = harness
        cheetah.start(harness.node)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._observed(cheetah.begin(self._harness.node)), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        torques = self._harness.make_packet("torques")
        torques.data = action.tolist()
        joints = cheetah.move(self._harness.node, torques)
        return self._observed(joints), 0.0, False, False, {}

    def _observed(self, joints: Any) -> Any:
        return np.concatenate([joints.position, joints.velocity])


def times_of_neuros(steps: int) -> dict[str, float]:
    """Of a session in a process beside this one."""
    with project() as folder:
        make = functools.partial(
            neuros.gym.make,
            folder,
            action=f"cheetah.torques.data[{len(MOTORS)}]",
            observation=[f"cheetah.joints.{part}[{len(JOINTS)}]" for part in _PARTS],
            reward=lambda: 0.0,
            model=MODEL.name,
            output=folder / "run",
            backend="in-process",
        )
        return times(make, steps)


def times_by_hand(steps: int) -> dict[str, float]:
    """Of hooks and messages alone."""
    with project() as folder, PluginHarness.from_project(folder, "cheetah") as harness:
        return times(lambda: ByHand(harness), steps)


@contextlib.contextmanager
def project() -> Iterator[Path]:
    """The folder of the project, with the model."""
    node = {
        "name": "cheetah",
        "plugin": "cheetah.py",
        "container": "neuros_mujoco",
        "inputs": [
            {
                "name": "torques",
                "type": "std_msgs/msg/Float64MultiArray",
                "mujoco": {"actuators": MOTORS},
            }
        ],
        "outputs": [
            {
                "name": "joints",
                "type": "sensor_msgs/msg/JointState",
                "mujoco": {"sensor": "joint_states", "element": JOINTS, "rate": 20},
            }
        ],
    }
    with project_of_plugins({"nodes": [node]}) as folder:
        shutil.copy(MODEL, folder)
        yield folder


def times(make: Callable[[], Any], steps: int) -> dict[str, float]:
    """Wall time of a step and of a reset, in microseconds: means."""
    env = make()
    try:
        env.reset(seed=0)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (EPISODE, len(MOTORS)))
        start_s = time.perf_counter()
        for number in range(steps):
            if number % EPISODE == 0:
                env.reset()
            env.step(actions[number % EPISODE])
        stepped_s = time.perf_counter() - start_s
        start_s = time.perf_counter()
        for _ in range(RESETS):
            env.reset()
        reset_s = (time.perf_counter() - start_s) / RESETS
    finally:
        env.close()
    return {"step": (stepped_s - steps / EPISODE * reset_s) / steps * US, "reset": reset_s * US}
