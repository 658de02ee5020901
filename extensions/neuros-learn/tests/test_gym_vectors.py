"""Vector environments of Gymnasium whose world is one node with copies."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import neuros
import neuros.gym
from neuros.errors import RunError, UsageError

COPIES, LONGEST, STEPS = 5, 40, 2
POLE = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body><joint name="slide" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
      <body><joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 .6" mass=".1"/></body></body>
  </worldbody>
  <actuator><motor joint="slide" gear="20"/></actuator>
</mujoco>
"""
PLUGIN = """
from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_reset
from neuros.simulators.mujoco import MuJoCoWorlds


def scatter(data, generator):
    data.qpos[:] = generator.uniform(-0.05, 0.05, 2)


@neuros_initialise(outputs="joints", batch=True)
def begin(node):
    worlds = MuJoCoWorlds(node, "pole.xml", begin=scatter, threads=2)
    node.set_user_data(worlds)
    return worlds.read("qpos", "qvel")


@neuros_reset(outputs="joints", batch=True)
def begin_again(node):
    worlds = node.get_user_data()
    worlds.reset()
    return worlds.read("qpos", "qvel")


@neuros_function(inputs=[Optional("force"), Optional("reset")], outputs="joints", batch=True)
def step(node, force, reset):
    worlds = node.get_user_data()
    worlds.step(force, 2, reset=reset)
    return worlds.read("qpos", "qvel")
"""
LEARNING = """
import numpy as np
from neuros.hooks import Optional, neuros_function, neuros_initialise


@neuros_initialise(outputs="joints", batch=True)
def begin(node):
    learnt = np.zeros(1)
    node.set_user_data(learnt)
    node.keep("learnt", lambda: learnt, lambda kept: np.copyto(learnt, kept))
    return node.make_packet("joints") + learnt


@neuros_function(inputs=[Optional("force"), Optional("reset")], outputs="joints", batch=True)
def step(node, force, reset):
    learnt = node.get_user_data()
    learnt += 1
    return node.make_packet("joints") + learnt
"""
NODE: dict[str, Any] = {
    "name": "poles",
    "container": "neuros_mujoco",
    "plugin": "poles.py",
    "copies": 2,
    "inputs": [{"name": "force", "type": "float64[1]"}, {"name": "reset", "type": "bool[1]"}],
    "outputs": [{"name": "joints", "type": "float64[4]"}],
    "environment": {"SEED": 1},
}


def reward(observation: Any, action: Any) -> Any:
    return np.cos(observation[..., 1]) - 0.01 * action[..., 0] ** 2


def done(observation: Any) -> Any:
    return np.abs(observation[..., 1]) > 0.2


class Pole(gymnasium.Env[Any, Any]):
    """The same world without NeuROS, as one environment."""

    observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(POLE)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-0.05, 0.05, 2)
        self.count = 0
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, STEPS)
        self.count += 1
        seen = self.observe()
        is_over, is_cut = bool(done(seen)), self.count >= LONGEST
        return seen, float(reward(seen, action)), is_over, is_cut, {}

    def observe(self) -> Any:
        return np.concatenate([self.data.qpos, self.data.qvel])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write(tmp_path)
    return tmp_path


def write(folder: Path, plugin: str = PLUGIN, **keys: Any) -> None:
    (folder / "poles.py").write_text(plugin)
    (folder / "pole.xml").write_text(POLE)
    node = {key: value for key, value in {**NODE, **keys}.items() if value is not None}
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))


ARGUMENTS: dict[str, Any] = {
    "num_envs": COPIES,
    "action": "poles.force",
    "observation": "poles.joints",
    "reset": "poles.reset",
    "reward": reward,
    "done": done,
    "ranges": {"poles.force": (-1.0, 1.0)},
    "max_episode_steps": LONGEST,
}


def poles(folder: Path, **others: Any) -> neuros.gym.ProjectVectorEnv:
    return neuros.gym.make_vec(folder, **{**ARGUMENTS, **others})


@pytest.fixture
def envs(folder: Path) -> Iterator[neuros.gym.ProjectVectorEnv]:
    made = poles(folder)
    yield made
    made.close()


def actions(count: int) -> Any:
    return np.random.default_rng(3).uniform(-0.3, 0.3, (count, COPIES, 1))


# ---------------------------------------------------------------------- as Gymnasium's own


@pytest.mark.parametrize("backend", ["local", "in-process", "process"])
def test_it_is_the_sync_vector_of_the_same_environments_bit_for_bit(
    folder: Path, backend: str
) -> None:
    ours: VectorEnv[Any, Any, Any] = poles(folder, backend=backend)
    theirs = SyncVectorEnv([Pole] * COPIES)
    seeds: list[Any] = [5, [11, 12, 3, 2**40, 5]]
    ends = np.zeros(2)
    for seed in seeds:
        assert np.array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
        for action in actions(120):
            found, expected = ours.step(action), theirs.step(action)
            for one, other in zip(found[:4], expected[:4], strict=True):
                assert np.array_equal(one, other)
                assert one.dtype == other.dtype
            ends += found[2].any(), found[3].any()
    assert all(ends)  # episodes that ended, and episodes that were cut short
    ours.close()
    theirs.close()


def test_its_spaces_and_metadata_are_those_of_a_vector(envs: Any) -> None:
    theirs = SyncVectorEnv([Pole] * COPIES)
    for name in ("single_observation_space", "single_action_space", "num_envs"):
        assert getattr(envs, name) == getattr(theirs, name)
    assert envs.observation_space == theirs.observation_space
    assert envs.action_space == theirs.action_space
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert isinstance(envs, VectorEnv)


def test_an_action_of_an_episode_that_begins_is_ignored(envs: Any) -> None:
    envs.reset(seed=1)
    for action in actions(200):
        _, rewards, *ends, _ = envs.step(action)
        if (over := ends[0] | ends[1]).any():
            break
    _, rewards, *ends, _ = envs.step(np.full((COPIES, 1), np.where(over, 1.0, 0.0)[:, None]))
    assert not rewards[over].any()
    assert rewards[~over].all()
    assert not (ends[0] | ends[1])[over].any()


def test_wrappers_of_gymnasium_take_it(envs: Any) -> None:
    wrapped = RecordEpisodeStatistics(envs)
    wrapped.reset(seed=1)
    lengths = []
    for action in actions(120):
        *_, info = wrapped.step(action)
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert lengths
    assert max(lengths) <= LONGEST


# ---------------------------------------------------------------------- seeds and settings


def test_a_seed_gives_one_sequence_of_episodes(envs: Any) -> None:
    def episodes(seed: Any) -> Any:
        first = envs.reset(seed=seed)[0]
        seen = [envs.step(action)[0] for action in actions(60)]
        return np.array([first, *seen, envs.reset()[0]])

    first = episodes(7)
    assert np.array_equal(episodes(7), first)
    assert not np.array_equal(episodes(8), first)
    assert not np.array_equal(first[-1], first[0])
    # A copy is that of its own seed, wherever it stands.
    assert np.array_equal(envs.reset(seed=[8, 9, 7, None, 7])[0][[2, 4]], [first[0][0]] * 2)


def test_settings_at_a_reset_hold_until_the_next_one(envs: Any) -> None:
    def second_step(**options: Any) -> Any:
        envs.reset(seed=1, options=options or None)
        return [envs.step(np.ones((COPIES, 1)))[0] for _ in range(2)][-1]

    strong = second_step()
    weak = second_step(set={"poles.model.actuator_gear": 2.0})
    assert np.all(weak[:, 2] < strong[:, 2])
    assert np.array_equal(second_step(), strong)
    with pytest.raises(UsageError, match="there is no option 'reset_mask'"):
        envs.reset(options={"reset_mask": np.ones(COPIES, bool)})


def test_what_plugins_keep_survives_a_reset_if_asked(folder: Path) -> None:
    write(folder, LEARNING)
    made = poles(folder)

    def learnt(**options: Any) -> float:
        """At the beginning of an episode, one step of which follows."""
        observation, _ = made.reset(seed=1, options=options)
        made.step(np.zeros((COPIES, 1)))
        return float(observation[0, 0])

    assert learnt() == 0
    assert learnt(keep="poles.learnt") == 1
    assert learnt(keep=True) == 2
    assert learnt(keep=False) == 0
    with pytest.raises(UsageError, match="keep: nothing in node 'poles' keeps 'learned'"):
        made.reset(options={"keep": "poles.learned"})
    made.close()


def test_pictures_are_arrays_of_all_copies(folder: Path) -> None:
    head, _, _ = PLUGIN.rpartition("@neuros_function")
    plugin = f"""{head}
@neuros_function(
    inputs=[Optional("force"), Optional("reset")], outputs=["joints", "picture"], batch=True
)
def step(node, force, reset):
    worlds, picture = node.get_user_data(), node.make_packet("picture")
    worlds.step(force, 2, reset=reset)
    picture[:, 1, 2, 0] = range(10, 10 + node.copies)
    return worlds.read("qpos", "qvel"), picture
"""
    outputs = [*NODE["outputs"], {"name": "picture", "type": "uint8[4,6,3]"}]
    write(folder, plugin, outputs=outputs)
    made = poles(folder, render_mode="rgb_array")
    assert made.render_mode == "rgb_array"
    assert made.metadata["render_modes"] == ["rgb_array"]
    made.reset(seed=1)
    assert [picture.shape for picture in made.render()] == [(4, 6, 3)] * COPIES
    made.step(np.zeros((COPIES, 1)))
    pictures = made.render()
    assert pictures is not None
    assert [int(picture[1, 2, 0]) for picture in pictures] == [10, 11, 12, 13, 14]
    made.close()


def test_num_envs_is_by_default_that_of_the_project(folder: Path) -> None:
    made = poles(folder, num_envs=None)
    assert made.num_envs == 2
    assert made.reset(seed=1)[0].shape == (2, 4)
    made.close()


# ---------------------------------------------------------------------- functions


def test_functions_return_a_value_for_each_copy_or_one_for_all(folder: Path) -> None:
    made = poles(
        folder,
        reward=lambda: 1,
        done=lambda: False,
        truncated=lambda observation, env: np.arange(len(observation)) == env.num_envs - 1,
        info=lambda observation: {"angle": observation[:, 1], "kind": 3},
    )
    _, info = made.reset(seed=1)
    assert set(info) >= {"angle", "_angle", "kind", "_kind"}
    seen, rewards, terminations, truncations, info = made.step(np.zeros((COPIES, 1)))
    assert rewards.tolist() == [1.0] * COPIES
    assert not terminations.any()
    assert truncations.tolist() == [False] * (COPIES - 1) + [True]
    assert np.array_equal(info["angle"], seen[:, 1])
    assert info["kind"].tolist() == [3] * COPIES
    assert info["_kind"].all()
    made.close()


@pytest.mark.parametrize(
    ("function", "text"),
    [
        ({"reward": lambda: "much"}, "reward returned 'much', which are no numbers"),
        ({"reward": lambda: [1.0, 2.0]}, r"reward returned an array of the shape \(2,\)"),
        ({"done": lambda observation: observation > 9}, r"done returned .* \(5, 4\)"),
        ({"info": lambda: 3}, "info returned 3, which is no mapping"),
        ({"info": lambda: {"x": [1, 2]}}, r"info: 'x' returned an array of the shape \(2,\)"),
    ],
)
def test_what_a_function_returns_is_checked(folder: Path, function: Any, text: str) -> None:
    made = poles(folder, **function)

    def act() -> None:
        made.reset(seed=1)
        made.step(np.zeros((COPIES, 1)))

    with pytest.raises(UsageError, match=text):
        act()
    made.close()


def test_actions_and_observations_may_have_parts(folder: Path) -> None:
    extra = [*NODE["outputs"], {"name": "angles", "type": "float64[2,2]"}]
    plugin = PLUGIN.replace('outputs="joints"', 'outputs=["joints", "angles"]')
    plugin = plugin.replace(
        'return worlds.read("qpos", "qvel")',
        'seen = worlds.read("qpos", "qvel")\n    return seen, seen.reshape(-1, 2, 2)',
    )
    write(folder, plugin, outputs=extra)
    made = poles(
        folder,
        action=["poles.force"],
        observation=["poles.joints", "poles.angles[4]"],
        reward=lambda: 0,
        done=lambda: False,
    )
    seen, _ = made.reset(seed=1)
    assert isinstance(made.single_observation_space, spaces.Dict)
    assert np.array_equal(seen["poles.joints"], seen["poles.angles"])
    assert made.observation_space.contains(seen)
    seen, *_ = made.step({"poles.force": np.ones((COPIES, 1))})
    assert seen["poles.angles"].shape == (COPIES, 4)
    made.close()


def test_a_clock_gives_all_copies_one_time(folder: Path) -> None:
    plugin = PLUGIN.replace('outputs="joints"', 'outputs=["joints", "clock"]').replace(
        'return worlds.read("qpos", "qvel")',
        'clock = node.make_packet("clock")\n    clock.clock = node.now()\n'
        '    return worlds.read("qpos", "qvel"), clock',
    )
    clock = {"name": "clock", "type": "rosgraph_msgs/msg/Clock"}
    write(folder, plugin, outputs=[*NODE["outputs"], clock])
    made = poles(folder, sim_s=0.1)
    made.reset(seed=1)
    *_, info = made.step(np.zeros((COPIES, 1)))
    assert info["sim_time"].tolist() == [pytest.approx(0.1)] * COPIES
    stamp = made.session["poles.clock"].packet.clock
    assert (stamp.sec, stamp.nanosec) == (0, 100_000_000)
    made.close()


def test_gymnasium_makes_it_by_a_registered_name(folder: Path) -> None:
    arguments = {**ARGUMENTS, "project": folder}
    del arguments["num_envs"]
    gymnasium.register(
        "neuros/Poles-v0", vector_entry_point="neuros.gym:make_vec", kwargs=arguments
    )
    made = gymnasium.make_vec("neuros/Poles-v0", 3, vectorization_mode="vector_entry_point")
    assert made.reset(seed=1)[0].shape == (3, 4)
    assert made.spec is not None
    assert made.spec.id == "neuros/Poles-v0"
    made.close()
    del gymnasium.registry["neuros/Poles-v0"]


# ---------------------------------------------------------------------- the end


def test_the_end_of_the_project_ends_all_episodes_and_the_next_step_begins_anew(
    folder: Path,
) -> None:
    ending = PLUGIN.replace(
        "worlds.step(force",
        "if worlds.sim_time > 0.1:\n        node.shutdown()\n    worlds.step(force",
    )
    write(folder, ending)
    made = poles(folder, max_episode_steps=None, done=lambda: False)
    made.reset(seed=1)
    for _ in range(50):
        _, _, terminations, *_ = made.step(np.zeros((COPIES, 1)))
        if terminations.all():
            break
    assert terminations.all()
    seen, rewards, terminations, *_ = made.step(np.zeros((COPIES, 1)))
    assert seen.shape == (COPIES, 4)
    assert not rewards.any()
    assert not terminations.any()
    assert np.all(np.abs(seen[:, :2]) <= 0.05)
    made.close()


def test_a_failing_hook_is_told(folder: Path) -> None:
    write(folder, PLUGIN.replace("worlds.step(force, 2", "worlds.step(force[:2], 2"))
    made = poles(folder)
    made.reset(seed=1)
    with pytest.raises(RunError, match="controls of 5 copies with 1 actuators"):
        made.step(np.zeros((COPIES, 1)))
    made.close()


# ---------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"num_envs": 0}, "num_envs=0: give a whole number from 1 on"),
        ({"num_envs": 2.5}, "num_envs=2.5: give a whole number from 1 on"),
        ({"reset": "poles.force"}, r"reset='poles.force': give an input with the type bool\[1\]"),
        ({"reset": "poles.rest"}, "'poles.rest': .* has no such output or input .*poles.reset"),
        ({"observation": "poles.joint"}, "has no such output .did you mean 'poles.joints'"),
        ({"observation": "poles.joints[5]"}, "its arrays have 4 numbers, not 5"),
        ({"action": "poles.force.data"}, "without fields: leave them out"),
        ({"ranges": {"poles.torque": (0, 1)}}, "ranges: 'poles.torque' is none of"),
        ({"max_episode_steps": 0}, "max_episode_steps=0: give a whole number from 1 on"),
        ({"model": "pole.xml"}, "neuros.gym.make_vec has no argument 'model'"),
        (
            {"render_mode": "rgb_array"},
            r"no output of .* sends uint8\[height,width,3\] of each copy",
        ),
        (
            {"render": "poles.joints"},
            r"'poles.joints': the output sends float64\[5,4\], not uint8",
        ),
        ({"reward": lambda state: 0}, "reward: there is nothing for its parameter 'state'"),
        ({"rounds": -1}, "rounds"),
    ],
)
def test_wrong_arguments_are_refused(folder: Path, wrong: Any, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        poles(folder, **wrong)


def test_a_project_without_copies_is_refused(folder: Path) -> None:
    write(folder, PLUGIN.replace(", batch=True", ""), copies=None)
    with pytest.raises(UsageError, match=r'needs a node with "copies".*SyncVectorEnv'):
        poles(folder)


def test_another_number_of_seeds_is_refused(envs: Any) -> None:
    with pytest.raises(UsageError, match="give 5 seeds, one for each copy, not 2"):
        envs.reset(seed=[1, 2])


def test_an_action_of_another_shape_is_refused(envs: Any) -> None:
    envs.reset(seed=1)
    with pytest.raises(UsageError, match=r"poles\.force takes 5 numbers, not 1"):
        envs.step(np.zeros(1))


# ---------------------------------------------------------------------- the pages

PAGES = Path(__file__).resolve().parents[3]


def blocks(page: str) -> list[str]:
    """The programs and node files of the section "Many worlds" of a page."""
    text = (PAGES / page).read_text("utf-8").partition("### Many worlds\n")[2]
    return re.findall(r"```(?:json|python)\n(.*?)```", text, re.DOTALL)


@pytest.fixture
def cheetahs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    model = Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml"
    shutil.copy(model, tmp_path)
    node, plugin = blocks("docs/simulators.md")[:2]
    (tmp_path / "cheetahs.py").write_text(plugin)
    (tmp_path / "project.json").write_text(f'{{"nodes": [{node}]}}')
    monkeypatch.chdir(tmp_path)
    return tmp_path


# Of Gymnasium's model.
DEPRECATED = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")


@DEPRECATED
def test_the_cheetahs_of_the_page_are_bare_mujoco_bit_for_bit(cheetahs: Path) -> None:
    envs = neuros.gym.make_vec(
        cheetahs,
        action="cheetahs.torques",
        observation="cheetahs.joints",
        reset="cheetahs.reset",
        reward=lambda: 0,
    )
    seen, _ = envs.reset(seed=3)
    model = mujoco.MjModel.from_xml_path("half_cheetah.xml")
    bare = [mujoco.MjData(model) for _ in range(16)]
    for index, data in enumerate(bare):
        generator = np.random.default_rng(3 + index)
        data.qpos[:] += generator.uniform(-0.1, 0.1, 9)
        data.qvel[:] += 0.1 * generator.standard_normal(9)
    for action in np.random.default_rng(1).uniform(-1, 1, (300, 16, 6)):
        expected = [np.concatenate([data.qpos, data.qvel]) for data in bare]
        assert seen.tobytes() == np.array(expected).tobytes()
        seen = envs.step(action)[0]
        for data, row in zip(bare, action, strict=True):
            data.ctrl[:] = row
            mujoco.mj_step(model, data, nstep=5)
    envs.close()


@DEPRECATED
def test_the_program_of_the_page_says_what_it_says(
    cheetahs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (program,) = blocks("extensions/neuros-learn/README.md")[:1]
    (cheetahs / "program.py").write_text(program)
    runpy.run_path(str(cheetahs / "program.py"))
    assert capsys.readouterr().out.splitlines()[-1] == "(32, 18) (32,)"
