"""A step of an environment: the half-cheetah as a project, against a bare environment.

All step the model of Gymnasium by five timesteps of 10 ms (``frame_skip``), with equal actions. The
bare one does what Gymnasium's ``MujocoEnv`` does. The one by hand calls the hooks of the project
with their messages, one after the other: no engine and no session with messages could be faster
than that. The one with arrays has array ports in place of messages. The second group is the example
of the cart that a policy balances: two nodes, and two packets in a round.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import runpy
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

import neuros.gym
from benchmarks.launching import project_of_plugins
from benchmarks.measure import Case, Figure, Group, Subject, Unavailable
from benchmarks.plugins import cheetah
from neuros.distribution import EXAMPLES
from neuros.testing import PluginHarness

LOCAL, ARRAYS, IN_PROCESS = "in the program's thread", "with arrays", "in process"
BY_HAND, BARE, GYMNASIUM = "by hand", "a bare environment", "HalfCheetah-v5"
CART, BARE_CART = "a cart and its policy", "a loop with the same computations"
CART_POLE = EXAMPLES / "7_learning" / "cartpole"
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
        LOCAL: functools.partial(times_of_neuros, steps, "local"),
        ARRAYS: functools.partial(times_with_arrays, steps),
        IN_PROCESS: functools.partial(times_of_neuros, steps, "in-process"),
        BY_HAND: functools.partial(times_by_hand, steps),
        GYMNASIUM: functools.partial(times_of_gymnasium, steps),
        BARE: functools.partial(times, Bare, steps),
    }
    cases = tuple(
        Case(name, "us", Figure(candidate, figure), Figure(BARE, figure), BARE)
        for name, candidate, figure in (
            ("a step of a cheetah, in the program's thread", LOCAL, "step"),
            ("the same with array ports", ARRAYS, "step"),
            ("the same in process", IN_PROCESS, "step"),
            ("its hooks and messages by hand", BY_HAND, "step"),
            ("Gymnasium's HalfCheetah-v5", GYMNASIUM, "step"),
            ("its reset, in the program's thread", LOCAL, "reset"),
            ("its reset, in process", IN_PROCESS, "reset"),
        )
    )
    cart = {
        CART: functools.partial(time_of_a_cart, steps),
        BARE_CART: functools.partial(time_of_a_bare_cart, steps),
    }
    case = Case(
        "a round of two nodes, a cart and its policy",
        "us",
        Figure(CART),
        Figure(BARE_CART),
        BARE_CART,
    )
    return Subject(
        "a step of an environment for learning, as a project and bare",
        (Group(candidates, cases), Group(cart, (case,))),
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


def times_of_neuros(steps: int, backend: str) -> dict[str, float]:
    """Of a session with messages."""
    with project() as folder:
        make = functools.partial(
            neuros.gym.make,
            folder,
            action=f"cheetah.torques.data[{len(MOTORS)}]",
            observation=[f"cheetah.joints.{part}[{len(JOINTS)}]" for part in _PARTS],
            reward=lambda: 0.0,
            model=MODEL.name,
            output=folder / "run",
            backend=backend,
        )
        return times(make, steps)


def times_with_arrays(steps: int) -> dict[str, float]:
    """Of a session in the program's thread whose packets are arrays."""
    action = {"type": f"float64[{len(MOTORS)}]", "mujoco": {"actuators": MOTORS}}
    sensor = {"sensor": "data", "element": ["qpos", "qvel"], "rate": 20}
    joints = {"type": f"float64[{2 * len(JOINTS)}]", "mujoco": sensor}
    with project(action, joints) as folder:
        make = functools.partial(
            neuros.gym.make,
            folder,
            action="cheetah.torques",
            observation="cheetah.joints",
            reward=lambda: 0.0,
            model=MODEL.name,
            output=folder / "run",
            backend="local",
        )
        return times(make, steps)


def times_of_gymnasium(steps: int) -> dict[str, float]:
    """Of Gymnasium's own environment."""
    if importlib.util.find_spec("imageio") is None:
        raise Unavailable("imageio, which Gymnasium's environments need, is not installed")
    make = functools.partial(gymnasium.make, "HalfCheetah-v5", disable_env_checker=True)
    return times(make, steps)


def time_of_a_cart(steps: int) -> float:
    """Microseconds of a round: the cart moves, and the policy answers with a force."""
    project = neuros.Project.from_file(CART_POLE)
    with (
        tempfile.TemporaryDirectory() as folder,
        project.session(backend="local", output=Path(folder) / "run") as session,
    ):
        session.step(EPISODE)
        start_s = time.perf_counter()
        for _ in range(steps):
            session.step()
        return (time.perf_counter() - start_s) / steps * US


def time_of_a_bare_cart(steps: int) -> float:
    """Microseconds of a turn of a loop that computes the same, on MuJoCo's arrays."""
    policy = runpy.run_path(str(CART_POLE / "policy.py"))
    layers, push = policy["read"](CART_POLE / "weights.txt"), policy["push"]
    model = mujoco.MjModel.from_xml_path(str(CART_POLE / "cart.xml"))
    data = mujoco.MjData(model)
    count = round(1.0 / policy["RATE_HZ"] / model.opt.timestep)
    start_s = time.perf_counter()
    for _ in range(steps):
        mujoco.mj_step(model, data, nstep=count)
        data.ctrl[0] = push(layers, data.qpos, data.qvel)
    return (time.perf_counter() - start_s) / steps * US


def times_by_hand(steps: int) -> dict[str, float]:
    """Of hooks and messages alone."""
    with project() as folder, PluginHarness.from_project(folder, "cheetah") as harness:
        return times(lambda: ByHand(harness), steps)


_TORQUES = {"type": "std_msgs/msg/Float64MultiArray", "mujoco": {"actuators": MOTORS}}
_JOINT_STATES = {
    "type": "sensor_msgs/msg/JointState",
    "mujoco": {"sensor": "joint_states", "element": JOINTS, "rate": 20},
}


@contextlib.contextmanager
def project(torques: Any = _TORQUES, joints: Any = _JOINT_STATES) -> Iterator[Path]:
    """The folder of the project, with the model, and with these ports."""
    node = {
        "name": "cheetah",
        "plugin": "cheetah.py",
        "container": "neuros_mujoco",
        "inputs": [{"name": "torques", **torques}],
        "outputs": [{"name": "joints", **joints}],
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
