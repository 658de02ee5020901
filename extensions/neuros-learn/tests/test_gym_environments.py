"""Environments of Gymnasium whose world is a project."""

from __future__ import annotations

import json
import pickle
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import nbclient
import nbformat
import numpy as np
import pytest
from cart_project import cart
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from std_msgs.msg import Float64

import neuros
import neuros.gym
from neuros.errors import ProjectError, RunError, UsageError

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "7_learning" / "cartpole"
PAGE = Path(__file__).resolve().parents[1] / "README.md"
POSITION, VELOCITY = "cart.joints.position", "cart.joints.velocity"
OBSERVED = [f"{POSITION}[2]", f"{VELOCITY}[2]"]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def one() -> float:
    return 1.0


def has_fallen(observation: Any) -> bool:
    return bool(abs(observation[POSITION][1]) > 0.2)


CART_POLE: dict[str, Any] = {
    "action": "policy.force",
    "observation": OBSERVED,
    "reward": one,
    "done": has_fallen,
    "model": "cart.xml",
    "max_episode_steps": 50,
}


def cart_pole(**others: Any) -> gymnasium.Env[Any, Any]:
    return neuros.gym.make(EXAMPLE / "project.json", **(CART_POLE | others))


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[gymnasium.Env[Any, Any]]:
    made = cart_pole(output=tmp_path_factory.mktemp("gym") / "run")
    yield made
    made.close()


def episode(env: gymnasium.Env[Any, Any], seed: int | None, steps: int = 5) -> list[Any]:
    """The observations of an episode in which the cart is pushed to the right."""
    found = [env.reset(seed=seed)[0]]
    found += [env.step(np.array([0.5]))[0] for _ in range(steps)]
    return [each[POSITION].tolist() for each in found]


def test_the_checker_of_gymnasium_finds_no_fault() -> None:
    made = cart_pole()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*Box observation space m.* is .*infinity")
        check_env(made.unwrapped)
    made.close()


def test_a_seed_gives_one_sequence_of_episodes(env: gymnasium.Env[Any, Any]) -> None:
    first = [episode(env, 7), episode(env, None)]
    assert [episode(env, 7), episode(env, None)] == first
    assert first[0] != first[1] != episode(env, 8)


def test_ranges_of_an_action_are_those_of_its_actuators(env: gymnasium.Env[Any, Any]) -> None:
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)


def test_an_episode_ends_when_it_is_done_or_long_enough(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=1)
    for _ in range(50):
        seen, reward, terminated, truncated, info = env.step(np.array([1.0]))
        if terminated:
            break
    assert reward == 1.0
    assert abs(seen[POSITION][1]) > 0.2
    assert not truncated
    assert 0.1 < info["sim_time"] < 1.0
    seen, _ = env.reset(seed=1)
    ends = []
    for _ in range(50):
        seen, _, *end, _ = env.step(np.array([4.0 * seen[POSITION][1]]))
        ends.append(end)
    assert ends == 49 * [[False, False]] + [[False, True]]


@pytest.mark.acceptance
def test_the_policy_of_the_project_gives_the_packets_of_its_own_run(
    tmp_path: Path, env: gymnasium.Env[Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is learnt in an environment holds for the node in the project."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    from policy import push, read

    layers = read(EXAMPLE / "weights.txt")
    taken_over = env.unwrapped.session  # type: ignore[attr-defined]
    taken_over.reset(seed=5)
    project = neuros.Project.from_file(EXAMPLE)
    with project.session(backend="in-process", seed=5, output=tmp_path / "run") as s:
        for _ in range(5):
            joints = taken_over["cart.joints"].packet
            assert joints == s["cart.joints"].packet
            force = push(layers, joints.position, joints.velocity)
            taken_over.send("cart.force", Float64(data=force))
            taken_over.step()
            s.step()


@pytest.mark.acceptance
class TestVectors:
    def test_side_by_side_in_one_process_and_in_several(self, tmp_path: Path) -> None:
        found = []
        for kind in (SyncVectorEnv, AsyncVectorEnv):
            envs = kind([cart_pole, cart_pole])
            try:
                seen, _ = envs.reset(seed=[3, 4])
                assert seen[POSITION].shape == (2, 2)
                seen, rewards, *_ = envs.step(np.array([[0.5], [0.5]]))
                assert rewards.tolist() == [1.0, 1.0]
                found.append(seen[POSITION].tolist())
            finally:
                envs.close()
        assert found[0] == found[1]
        assert found[0][0] != found[0][1]


SENDER = """
from neuros.hooks import neuros_function, Optional

@neuros_function(inputs=[Optional("order"), Optional("flag")], outputs=["scan", "imu", "done"])
def step(node, order, flag):
    scan, imu, done = (node.make_packet(name) for name in ("scan", "imu", "done"))
    scan.data = bytes([1, 2, 3, 4, 5, 6])
    imu.header.stamp.sec = 5
    imu.angular_velocity.z = 2.0 if order is None else order.linear.x
    imu.orientation_covariance[8] = 9.0
    done.data = flag is not None and flag.data
    return scan, imu, done
"""


@pytest.fixture
def sensors(tmp_path: Path) -> Path:
    """A node with messages of many kinds."""
    (tmp_path / "sender.py").write_text(SENDER)

    def port(name: str, kind: str) -> dict[str, str]:
        return {"name": name, "type": kind}

    node = {
        "name": "robot",
        "plugin": "sender.py",
        "container": "neuros_python",
        "inputs": [port("order", "geometry_msgs/msg/Twist"), port("flag", "std_msgs/msg/Bool")],
        "outputs": [
            port("scan", "sensor_msgs/msg/Image"),
            port("imu", "sensor_msgs/msg/Imu"),
            port("done", "std_msgs/msg/Bool"),
        ],
    }
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}))
    return tmp_path


def test_spaces_follow_from_the_types_of_messages(sensors: Path) -> None:
    env = neuros.gym.make(
        sensors,
        action=["robot.order", "robot.flag"],
        observation=["robot.scan.data[2,3]", "robot.imu", "robot.imu.angular_velocity"],
        reward=lambda observation: observation["robot.imu.angular_velocity"][2],
        done=lambda session: session["robot.done"].packet.data,
        ranges={"robot.order": (-2, [1, 2, 3, 4, 5, 6])},
    )
    try:
        seen = env.observation_space
        assert isinstance(seen, gymnasium.spaces.Dict)
        assert seen["robot.scan.data"] == gymnasium.spaces.Box(0, 255, (2, 3), np.uint8)
        # 4 of the orientation, 3 + 3 of the rates, and three times 9 covariances: no stamp.
        assert seen["robot.imu"].shape == (37,)
        assert isinstance(env.action_space, gymnasium.spaces.Dict)
        order = env.action_space["robot.order"]
        assert order == gymnasium.spaces.Box(
            np.full(6, -2.0), np.arange(1.0, 7.0), dtype=np.float64
        )
        assert env.action_space["robot.flag"] == gymnasium.spaces.Box(0, 1, (1,), np.uint8)
        first, _ = env.reset(seed=1)
        assert env.observation_space.contains(first)
        assert first["robot.scan.data"].tolist() == [[1, 2, 3], [4, 5, 6]]
        assert first["robot.imu"][12] == 9.0
        assert first["robot.imu.angular_velocity"].tolist() == [0.0, 0.0, 2.0]
        action = {"robot.order": np.array([0.5, 0, 0, 0, 0, 0]), "robot.flag": np.array([1])}
        seen_then, reward, terminated, *_ = env.step(action)
        assert reward == seen_then["robot.imu.angular_velocity"][2] == 0.5
        assert terminated
    finally:
        env.close()


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"observation": "robot.scann"}, r"did you mean 'robot\.scan'\?"),
        ({"observation": "robot.order"}, "no such output"),
        ({"observation": "robot.imu.rate"}, r"there are robot\.imu\.orientation\.x, "),
        ({"observation": "robot.scan.data"}, r"length of robot\.scan\.data is not known: .*\[3\]'"),
        ({"observation": "robot.imu[7]"}, "its messages have 37 numbers, not 7"),
        ({"observation": "robot"}, r"say node\.port, node\.port\.field or"),
        ({"action": "robot.imu"}, "the output is connected to no input"),
        ({"ranges": {"robot.imu": (0, 1)}}, "ranges: 'robot.imu' is none of robot.order, robot"),
        ({"observation": 5}, "names, or lists of names, not 5"),
        ({"action": ["robot.order", None]}, "names, or lists of names, not "),
        ({"ranges": {"robot.order": (0, [1, 2])}}, "range of robot.order: "),
        ({"ranges": {"robot.order": (0, float("nan"))}}, "range of robot.order: the lowest"),
        ({"ranges": {"robot.order": (1, -1)}}, "range of robot.order: the lowest value must be"),
        ({"ranges": {"robot.order": 3}}, "range of robot.order: "),
        ({"ranges": {"robot.flag": (0, 300)}, "action": "robot.flag"}, "range of robot.flag: "),
        ({"model": "nothing.xml"}, "nothing.xml"),
        ({"rendermode": "rgb_array"}, r"neuros\.gym\.make has no .*did you mean 'render_mode'\?"),
        ({"ouput": "run"}, r"no argument 'ouput' \(did you mean 'output'\?\)"),
        ({"rounds": 1, "sim_s": 0.1}, "rounds and sim_s are lengths of one step: give one of them"),
        ({"rounds": 1.5}, "rounds=1.5: give a whole number"),
        ({"take_over": "robot.flag"}, "no argument 'take_over'"),
        ({"max_episode_steps": 0}, "max_episode_steps=0: give a whole number from 1 on"),
        ({"max_episode_steps": 2.5}, "max_episode_steps=2.5: give a whole number"),
        ({"max_episode_steps": "50"}, "max_episode_steps='50': give a whole number"),
        ({"reward": lambda obs: 0.0}, "reward: there is nothing for its parameter 'obs' .*there"),
        ({"done": lambda actions: False}, r"done: .*'actions' \(did you mean 'action'\?\)"),
        ({"truncated": True}, "truncated: True is no function .*give a function of observation"),
        ({"info": dict}, "info: <class 'dict'> is no function with known parameters"),
    ],
)
def test_what_cannot_be_is_said_with_what_can(
    sensors: Path, changed: dict[str, Any], complaint: str
) -> None:
    arguments = {"action": "robot.order", "observation": "robot.done", "reward": float}
    with pytest.raises(UsageError, match=complaint):
        neuros.gym.make(sensors, **(arguments | changed))
    assert not (sensors / "runs").exists()


def test_functions_get_what_their_parameters_name(sensors: Path) -> None:
    def gained(
        action: Any, previous_observation: Any, observation: Any, scale: float = 2.0
    ) -> float:
        return scale * float(observation[2] - previous_observation[2]) - 0.5 * float(action[0])

    env = neuros.gym.make(
        sensors,
        action="robot.order",
        observation="robot.imu.angular_velocity",
        reward=gained,
        done=lambda env, action: env.action is not action,
        truncated=lambda observation: observation[2] > 3.0,
        info=lambda action, previous_observation, session: {
            "first": previous_observation is None and action is None,
            "sent": session["robot.done"].count,
        },
    )
    try:
        _, info = env.reset()
        assert info == {"first": True, "sent": 1}
        *_, reward, terminated, truncated, info = env.step(np.array([3.0, 0, 0, 0, 0, 0]))
        assert (reward, terminated, truncated) == (2.0 * (3.0 - 2.0) - 0.5 * 3.0, False, False)
        assert info == {"first": False, "sent": 2}
        *_, truncated, info = env.step(np.array([3.5, 0, 0, 0, 0, 0]))
        assert truncated
    finally:
        env.close()


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"reward": lambda: None}, "reward returned None, which is no number"),
        ({"reward": lambda observation: "much"}, "reward returned 'much', which is no number"),
        (
            {"info": lambda action: {} if action is None else 3},
            "info returned 3, which is no mapping",
        ),
    ],
)
def test_what_a_function_must_return_is_said(
    sensors: Path, changed: dict[str, Any], complaint: str
) -> None:
    arguments = {"action": "robot.order", "observation": "robot.done", "reward": float}
    env = neuros.gym.make(sensors, **(arguments | changed))
    try:
        env.reset()
        with pytest.raises(UsageError, match=complaint):
            env.step(np.zeros(6))
    finally:
        env.close()


class TestOptionsOfAReset:
    @pytest.mark.parametrize(
        ("options", "complaint"),
        [
            ({"nonsense": 1}, "reset: there is no option 'nonsense'; settings are options=.*set"),
            ({"set": {}, "seed": 3}, "reset: there is no option 'seed'"),
            (
                {"set": "nodes.cart.environment.MASS=2"},
                "'set' is a mapping of settings, not 'nodes",
            ),
        ],
    )
    def test_that_there_are_not_are_refused(
        self, env: gymnasium.Env[Any, Any], options: dict[str, Any], complaint: str
    ) -> None:
        before = episode(env, 7)
        episode(env, 7)
        random = env.unwrapped.np_random.bit_generator.state
        with pytest.raises(UsageError, match=complaint):
            env.reset(seed=1, options=options)
        assert env.unwrapped.np_random.bit_generator.state == random
        assert episode(env, 7) == before

    def test_settings_hold_until_the_next_reset(self, env: gymnasium.Env[Any, Any]) -> None:
        def speed(options: dict[str, Any] | None) -> float:
            env.reset(seed=7, options=options)
            return float(env.step(np.array([1.0]))[0][VELOCITY][0])

        usual = speed(None)
        slack = speed({"set": {"cart.model.actuator_gear": 0.0}})
        assert usual > slack + 0.1
        assert [speed(options) for options in (None, {}, {"set": None}, {"set": {}})] == 4 * [usual]

    def test_a_setting_of_a_node_that_there_is_not_is_refused(
        self, env: gymnasium.Env[Any, Any]
    ) -> None:
        with pytest.raises(UsageError, match=r"no node 'card' \(did you mean 'cart'\?\)"):
            env.reset(options={"set": {"card.model.actuator_gear": 0.0}})


class TestRegistration:
    """Environments by a name, as Gymnasium makes them."""

    ID = "neuros/CartPole-v3"

    @pytest.fixture(autouse=True)
    def _registered(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        monkeypatch.chdir(EXAMPLE)
        neuros.gym.register(self.ID, "project.json", **CART_POLE)
        monkeypatch.undo()  # back in the folder of the test
        yield
        del gymnasium.registry[self.ID]

    @pytest.fixture(autouse=True)
    def _infinite(self) -> Iterator[None]:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*Box observation space m.* is .*infinity")
            yield

    def test_a_name_makes_the_environment_in_any_folder(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env: gymnasium.Env[Any, Any]
    ) -> None:
        monkeypatch.chdir(tmp_path)
        made = gymnasium.make(self.ID, max_episode_steps=3)
        try:
            assert episode(made, 7, steps=3) == episode(env, 7, steps=3)
            assert made.spec is not None
            assert made.spec.id == self.ID
            assert made.spec.max_episode_steps == 3
        finally:
            made.close()

    @pytest.mark.acceptance
    def test_a_specification_survives_pickling_and_makes_the_same_environment(
        self, env: gymnasium.Env[Any, Any]
    ) -> None:
        for known in (gymnasium.spec(self.ID), env.spec):
            made = pickle.loads(pickle.dumps(known)).make(output=None)
            try:
                assert episode(made, 7) == episode(env, 7)
                assert made.spec.max_episode_steps == 50
            finally:
                made.close()

    @pytest.mark.acceptance
    @pytest.mark.parametrize(("mode", "more"), [("sync", {}), ("async", {"context": "spawn"})])
    def test_a_vector_has_a_run_for_each(
        self,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        mode: str,
        more: dict[str, Any],
        env: gymnasium.Env[Any, Any],
    ) -> None:
        monkeypatch.chdir(tmp_path)
        envs = gymnasium.make_vec(self.ID, num_envs=2, vectorization_mode=mode, vector_kwargs=more)
        try:
            seen, _ = envs.reset(seed=[7, 8])
            found = [each.tolist() for each in seen[POSITION]]
        finally:
            envs.close()
        assert found == [episode(env, seed, steps=0)[0] for seed in (7, 8)]

    def test_a_project_of_any_name_has_a_specification(self, tmp_path: Path) -> None:
        folder = shutil.copytree(EXAMPLE, tmp_path / "der Läufer: v2 (alt)")
        made = neuros.gym.make(folder, **CART_POLE)
        try:
            assert made.spec is not None
            assert made.spec.id == "neuros/der_Läufer__v2__alt_-v0"
        finally:
            made.close()

    def test_an_argument_that_there_is_not_is_refused_at_once(self) -> None:
        with pytest.raises(UsageError, match=r"no argument 'actions' \(did you mean 'action'\?\)"):
            neuros.gym.register("neuros/Other-v0", EXAMPLE, actions="policy.force")
        assert "neuros/Other-v0" not in gymnasium.registry

    def test_an_argument_of_gymnasium_make_that_there_is_not_is_refused(self) -> None:
        with pytest.raises(UsageError, match=r"neuros\.gym\.make has no argument 'ranges_of'"):
            gymnasium.make(self.ID, ranges_of={})


@pytest.mark.acceptance
def test_a_length_that_messages_do_not_have_is_said_with_that_they_have(sensors: Path) -> None:
    arguments = {"action": "robot.order", "observation": "robot.scan.data[7]", "reward": float}
    env = neuros.gym.make(sensors, **arguments)
    try:
        with pytest.raises(UsageError, match=r"robot\.scan\.data holds 6 numbers, not 7"):
            env.reset()
    finally:
        env.close()


@pytest.mark.acceptance
def test_a_project_that_waits_for_a_command_gets_one_at_each_reset(tmp_path: Path) -> None:
    def brain(**others: Any) -> gymnasium.Env[Any, Any]:
        return neuros.gym.make(
            cart(tmp_path / str(len(others))),
            action="robot.pose",
            observation="brain.command",
            reward=float,
            **others,
        )

    for folder in ("0", "1"):
        (tmp_path / folder).mkdir()
    waiting, served = brain(), brain(initial_action=[4.0])
    try:
        with pytest.raises(UsageError, match=r"brain\.command has sent nothing.*initial_action"):
            waiting.reset()
        for _ in range(2):
            assert served.reset()[0].tolist() == [-2.0]
    finally:
        waiting.close()
        served.close()


def test_a_project_with_problems_is_refused_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "project.json").write_text("{}")
    with pytest.raises(ProjectError):
        neuros.gym.make(tmp_path, action="a.b", observation="a.c", reward=float)


def test_without_gymnasium_the_command_that_installs_it_is_told() -> None:
    program = "import sys; sys.modules['gymnasium'] = None\nimport neuros.gym"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert re.search(r"EnvironmentFault: neuros\.gym needs Gymnasium.*(extras rl|\[rl\])", last)


def test_the_code_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(shutil.copytree(EXAMPLE, tmp_path / "cartpole"))
    codes = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    codes = [code for code in codes if "gym.make_vec(" not in code]  # test_gym_vectors.py runs it
    exec(compile("\n".join(codes), str(PAGE), "exec"), {"__name__": "page"})
    assert "steps" in capsys.readouterr().out


def test_weights_of_the_example_that_are_missing_are_its_only_error(tmp_path: Path) -> None:
    missing = {"nodes.policy.environment.POLICY": "nothing.txt"}
    with pytest.raises(RunError, match=r"'nothing\.txt' does not exist"):
        neuros.Project.from_file(EXAMPLE).session(set=missing, output=tmp_path / "run")
    assert (tmp_path / "run" / "policy" / "node.log").read_text().count("[ERROR]") == 1


@pytest.mark.acceptance
def test_a_policy_is_learnt_in_two_minutes_and_balances_as_a_node(tmp_path: Path) -> None:
    made = shutil.copytree(EXAMPLE, tmp_path / "cartpole")
    (made / "weights.txt").write_text("0\n0\n0\n0\n")
    project = neuros.Project.from_file(made)
    before = project.run(backend="in-process", duration="10sim", output=tmp_path / "before")
    subprocess.run([sys.executable, "train.py"], cwd=made, check=True)
    for seed in (1, 2, 3):
        run = project.run(backend="in-process", duration="10sim", seed=seed).check()
        assert run.node_results["policy"]["upright_s"] > 9.9
    assert before.node_results["policy"]["upright_s"] < 3.0


def test_a_network_that_stable_baselines3_has_trained_balances_as_a_node(tmp_path: Path) -> None:
    assert _upright_s(EXAMPLE, tmp_path, seeds=(1, 2, 3)) == [pytest.approx(10.0, abs=0.1)] * 3


@pytest.mark.acceptance
def test_stable_baselines3_trains_it_in_two_minutes_and_the_node_acts_as_its_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3", reason="pip install torch stable-baselines3")
    made = shutil.copytree(EXAMPLE, tmp_path / "cartpole")
    monkeypatch.syspath_prepend(str(made))
    import policy
    import train_sb3

    env = train_sb3.make_flat()
    try:
        model = train_sb3.learn(env)
    finally:
        env.close()
    train_sb3.write(made / "network.npz", model)
    train_sb3.write(made / "balance.onnx", model)
    exported = neuros.Project.from_file(made / "exported.json")
    exported.run(backend="in-process", duration="1sim", output=tmp_path / "exported").check()
    layers = policy.read(made / "network.npz")
    for seen in np.random.default_rng(1).normal(0.0, 0.3, (100, 4)):
        force = policy.push(layers, seen[:2], seen[2:])
        assert force == pytest.approx(model.predict(seen, deterministic=True)[0][0], abs=1e-5)
    assert min(_upright_s(made, tmp_path, seeds=(1, 2, 3))) > 9.9


@pytest.mark.acceptance
def test_the_notebook_learns_it_and_runs_what_it_has_learnt_as_a_node(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="pip install torch stable-baselines3")
    made = shutil.copytree(EXAMPLE, tmp_path / "cartpole")
    (made / "network.npz").unlink()
    notebook = nbformat.read(made / "learn.ipynb", as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": made}})
    client.execute()
    *_, upright = notebook.cells[-1].outputs
    assert float(upright["data"]["text/plain"]) > 9.9


def _upright_s(example: Path, folder: Path, seeds: Sequence[int]) -> list[float]:
    """For how long the network of an example keeps the pole upright in 10 s of simulated time."""
    project = neuros.Project.from_file(example)
    network = project.with_settings({"nodes.policy.environment.POLICY": "network.npz"})
    runs = [
        network.run(
            backend="in-process", duration="10sim", seed=seed, output=folder / f"run{seed}"
        ).check()
        for seed in seeds
    ]
    return [run.node_results["policy"]["upright_s"] for run in runs]


# ---------------------------------------------------------------------- ports of arrays

# Of Gymnasium's model.
DEPRECATED = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
SIMULATORS = ROOT / "docs" / "simulators.md"


def cheetah(folder: Path) -> Path:
    """The half-cheetah of the page, whose action and observation are arrays."""
    model = Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml"
    shutil.copy(model, folder)
    page = SIMULATORS.read_text("utf-8").partition("### Arrays\n")[2]
    node, plugin = re.findall(r"```(?:json|python)\n(.*?)```", page, re.DOTALL)[:2]
    (folder / "cheetah.py").write_text(plugin)
    (folder / "project.json").write_text(f'{{"nodes": [{node}]}}')
    return folder


def run_cheetah(folder: Path, **others: Any) -> gymnasium.Env[Any, Any]:
    arguments: dict[str, Any] = {
        "action": "cheetah.action",
        "observation": "cheetah.observation",
        "reward": lambda env: float(env.observation[8]),
        "model": "half_cheetah.xml",
    }
    return neuros.gym.make(cheetah(folder), **(arguments | others))


@DEPRECATED
def test_ports_of_arrays_have_spaces_of_their_type_and_shape(tmp_path: Path) -> None:
    env = run_cheetah(tmp_path)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float64)
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (17,), np.float64)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*Box observation space m.* is .*infinity")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


@DEPRECATED
def test_a_cheetah_of_arrays_is_bare_mujoco_bit_for_bit(tmp_path: Path) -> None:
    import mujoco

    env = run_cheetah(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "half_cheetah.xml"))
    for _ in range(2):
        observation, _ = env.reset()
        bare = mujoco.MjData(model)
        mujoco.mj_step(model, bare, nstep=5)  # without an action
        assert np.array_equal(observation, np.concatenate([bare.qpos[1:], bare.qvel]))
        for action in np.random.default_rng(1).uniform(-1, 1, (100, 6)):
            observation = env.step(action)[0]
            bare.ctrl[:] = action
            mujoco.mj_step(model, bare, nstep=5)
            assert observation.tobytes() == np.concatenate([bare.qpos[1:], bare.qvel]).tobytes()
        observation[:] = 0  # is the program's own
    env.close()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"action": "cheetah.action.data[6]"}, r"cheetah.action is a float64\[6\], without fields"),
        ({"observation": "cheetah.observation[18]"}, "its arrays have 17 numbers, not 18"),
        ({"action": "cheetah.actoin"}, "did you mean 'cheetah.action'"),
    ],
)
def test_wrong_names_of_arrays_are_told(tmp_path: Path, arguments: Any, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        run_cheetah(tmp_path, **arguments)


MIRROR = """
from neuros.hooks import Optional, neuros_function

@neuros_function(inputs=[Optional("on"), Optional("level")], outputs=[Optional("is_on"), "image"])
def show(node, on, level):
    image = node.make_packet("image")
    if level is not None:
        image[:] = level.reshape(2, 2)
    return on if on is None else ~on, image
"""


def test_arrays_of_bools_and_whole_numbers_and_any_shape(tmp_path: Path) -> None:
    (tmp_path / "mirror.py").write_text(MIRROR)
    types = {"on": "bool[2]", "level": "uint8[4]", "is_on": "bool[2]", "image": "float32[2,2]"}
    ports = [{"name": name, "type": kind} for name, kind in types.items()]
    node = {"name": "m", "container": "neuros_python", "plugin": "mirror.py"}
    node |= {"inputs": ports[:2], "outputs": ports[2:]}
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}))
    env = neuros.gym.make(
        tmp_path,
        action=["m.on", "m.level"],
        observation=["m.is_on", "m.image"],
        reward=lambda env: 0.0,
        initial_action={"m.on": [0, 0], "m.level": [0, 0, 0, 0]},
        output=tmp_path / "run",
    )
    box = gymnasium.spaces.Box
    assert env.action_space["m.on"] == box(0, 1, (2,), np.uint8)
    assert env.action_space["m.level"] == box(0, 255, (4,), np.uint8)
    assert env.observation_space["m.image"] == box(-np.inf, np.inf, (2, 2), np.float32)
    env.reset()
    action = {"m.on": np.array([0, 1], np.uint8), "m.level": np.array([1.0, 2.0, 3.4, 255.0])}
    seen = env.step(action)[0]
    assert seen["m.is_on"].tolist() == [1, 0]
    assert seen["m.image"].tolist() == [[1.0, 2.0], [3.0, 255.0]]
    for wrong in ([0, 0, 0, 256], [0, 0, 0, -1], [0, 0, 0, np.nan]):
        with pytest.raises(ValueError, match=r"m.level: .* does not fit in uint8\[4\]"):
            env.step(action | {"m.level": np.array(wrong)})
    with pytest.raises(UsageError, match=r"m\.on takes 2 numbers, not 3"):
        env.step(action | {"m.on": np.zeros(3)})
    env.close()
