"""Datasets from recorded runs: the steps of a policy as arrays, and opened by Minari."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import neuros
import neuros.datasets
from neuros.errors import EnvironmentFault, UsageError

ROBOT = """
from neuros.hooks import neuros_function, neuros_initialise

def look(node, step):
    node.set_user_data(step)
    pose, camera = node.make_packet("pose"), node.make_packet("camera")
    pose.header.stamp.sec = 7
    pose.point.x, pose.point.y = float(step), -float(step)
    camera.height, camera.width, camera.step, camera.encoding = 2, 1, 3, "bgr8"
    camera.data = bytes([step, 0, 255] * 2)
    return camera, pose

@neuros_initialise(outputs=["camera", "pose"])
def start(node):
    return look(node, 0)

@neuros_function(inputs="command", outputs=["camera", "pose"])
def move(node, command):
    step = node.get_user_data() + 1
    if step == 4:
        node.shutdown("four steps")
    return look(node, step)
"""
BRAIN = """
from neuros.hooks import neuros_function

@neuros_function(inputs=["camera", "pose"], outputs=["command", "said", "joints"])
def act(node, camera, pose):
    command, said = node.make_packet("command"), node.make_packet("said")
    command[0] = 10.0 * pose.point.x
    said.data = [1] * int(pose.point.x)
    joints = node.make_packet("joints")
    joints.name, joints.position = ["a", "b"], [pose.point.x, 1.0]
    return command, said, joints
"""
LISTENER = """
from neuros.hooks import neuros_function

@neuros_function(inputs="said")
def hear(node, said):
    pass

@neuros_function(inputs="joints")
def feel(node, joints):
    pass
"""
POSE, CAMERA, COMMAND = "robot.pose.point", "robot.camera", "brain.command"


def port(name: str, kind: str) -> dict[str, str]:
    return {"name": name, "type": kind}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("datasets")
    seen = [port("camera", "sensor_msgs/msg/Image"), port("pose", "geometry_msgs/msg/PointStamped")]
    command = port("command", "float64[1]")
    said = port("said", "std_msgs/msg/UInt8MultiArray")
    joints = port("joints", "sensor_msgs/msg/JointState")
    nodes: list[dict[str, Any]] = [
        {"name": "robot", "outputs": seen, "inputs": [command]},
        {"name": "brain", "outputs": [command, said, joints], "inputs": seen},
        {"name": "listener", "inputs": [said, joints]},
    ]
    plugins = {"robot": ROBOT, "brain": BRAIN, "listener": LISTENER}
    for node in nodes:
        node |= {"plugin": f"{node['name']}.py", "container": "neuros_python"}
        (folder / node["plugin"]).write_text(plugins[node["name"]])
    ends = ["robot.camera brain", "robot.pose brain", "brain.command robot"]
    ends += ["brain.said listener", "brain.joints listener"]
    connections = []
    for end in ends:
        source, destination = end.split()
        node_name, output = source.split(".")
        connections.append(
            {
                "source_node": node_name,
                "source_output": output,
                "destination_node": destination,
                "destination_input": output,
                "discard_limit": 0,
            }
        )
    (folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": connections}))
    project = neuros.Project.from_file(folder)
    made = project.run(backend="in-process", record=True, output=folder / "run").check()
    return Path(made.folder)


def test_each_step_has_what_was_seen_and_the_answer_to_it(run: Path) -> None:
    steps = neuros.datasets.steps(run, [POSE, CAMERA], COMMAND)
    seen = steps.observation[POSE]
    assert seen[:4].tolist() == [[x, -x, 0.0] for x in (0.0, 1.0, 2.0, 3.0)]
    assert steps.action[COMMAND].ravel().tolist() == (10 * seen[:, 0]).tolist()
    assert len(steps) == len(seen) == len(steps.time_s) >= 4
    assert np.all(np.diff(steps.time_s) >= 0)


def test_an_image_has_rows_columns_and_channels_in_the_order_rgb(run: Path) -> None:
    pixels = neuros.datasets.steps(run, [POSE, CAMERA], COMMAND).observation[CAMERA]
    assert pixels.shape[1:] == (2, 1, 3)
    assert pixels.dtype == np.uint8
    assert pixels[1, 0, 0].tolist() == [255, 0, 1]


@pytest.mark.parametrize("observation", [[POSE, CAMERA], [CAMERA, POSE]])
def test_what_a_hook_has_sent_together_is_in_one_step(run: Path, observation: list[str]) -> None:
    seen = neuros.datasets.steps(run, observation, COMMAND).observation
    assert seen[CAMERA][:, 0, 0, 2].tolist() == seen[POSE][:, 0].tolist()


def test_all_numbers_of_a_message_are_taken_but_those_of_its_time_stamp(run: Path) -> None:
    all_of_it = neuros.datasets.steps(run, "robot.pose", COMMAND).observation["robot.pose"]
    point = neuros.datasets.steps(run, POSE, COMMAND).observation[POSE]
    assert all_of_it.tolist() == point.tolist()
    stamp = neuros.datasets.steps(run, "robot.pose.header.stamp.sec", COMMAND)
    assert set(stamp.observation["robot.pose.header.stamp.sec"].ravel().tolist()) == {7}


def test_arrays_of_a_message_with_texts_are_taken_where_their_length_stays(run: Path) -> None:
    steps = neuros.datasets.steps(run, POSE, "brain.joints")
    position = steps.action["brain.joints"]
    assert position.tolist() == [[x, 1.0] for x in steps.observation[POSE][:, 0]]


@pytest.mark.parametrize(
    ("observation", "action", "said"),
    [
        ("robot.smell", COMMAND, "robot.smell"),
        ("robot.pose.pint", COMMAND, "has no field 'pint'"),
        ("robot.pose.header.frame_id", COMMAND, "holds no numbers"),
        (POSE, "brain.said", "data changes its length"),
        ([], COMMAND, "name an output"),
        ([POSE, POSE], COMMAND, "each once"),
    ],
)
def test_what_cannot_be_a_column_is_refused_by_name(
    run: Path, observation: Any, action: str, said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        neuros.datasets.steps(run, observation, action)


@pytest.fixture
def minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    if sys.version_info < (3, 11):
        pytest.skip("there is no Minari for this Python")
    library = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return library


# Minari warns of each part of its metadata that nobody gives.
@pytest.mark.filterwarnings("ignore::UserWarning:minari")
def test_minari_opens_a_dataset_with_an_episode_for_each_run(run: Path, minari: Any) -> None:
    neuros.datasets.minari(
        [run, run],
        "neuros/steps-v0",
        [POSE, CAMERA],
        COMMAND,
        reward=lambda observation, action: observation[POSE][0] + action[0],
    )
    opened = minari.load_dataset("neuros/steps-v0")
    episodes = list(opened.iterate_episodes())
    expected = neuros.datasets.steps(run, [POSE, CAMERA], COMMAND)
    last = len(expected) - 1
    assert len(episodes) == 2
    for episode in episodes:
        assert episode.observations[POSE].tolist() == expected.observation[POSE].tolist()
        assert episode.observations[CAMERA].tolist() == expected.observation[CAMERA].tolist()
        assert episode.actions.tolist() == expected.action[COMMAND][:-1].tolist()
        assert episode.rewards[:3].tolist() == [1.0, 12.0, 23.0]
        assert episode.truncations.tolist() == [*[False] * (last - 1), True]
        assert not episode.terminations.any()
    assert opened.spec.observation_space[CAMERA].shape == (2, 1, 3)


def test_a_dataset_needs_a_run(minari: Any) -> None:
    with pytest.raises(UsageError, match="a dataset needs a run"):
        neuros.datasets.minari([], "neuros/none-v0", POSE, COMMAND)


# ------------------------------------------------------------------ LeRobot


class Written:
    """Stands for ``LeRobotDataset``, which needs PyTorch, and keeps what it is given."""

    def __init__(self, repo_id: str, fps: int, features: dict[str, Any], **options: Any) -> None:
        self.repo_id, self.fps, self.features, self.options = repo_id, fps, features, options
        self.frames: list[dict[str, Any]] = []
        self.episodes: list[int] = []
        self.is_final = False

    @classmethod
    def create(cls, *arguments: Any, **options: Any) -> Written:
        return cls(*arguments, **options)

    def add_frame(self, frame: dict[str, Any]) -> None:
        assert frame.keys() == {*self.features, "task"}
        for key, feature in self.features.items():
            assert frame[key].shape == tuple(feature["shape"])
            assert str(frame[key].dtype) == {"image": "uint8"}.get(feature["dtype"], "float32")
        self.frames.append(frame)

    def save_episode(self) -> None:
        self.episodes.append(len(self.frames))

    def finalize(self) -> None:
        self.is_final = True


@pytest.fixture
def lerobot(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("lerobot.datasets.lerobot_dataset")
    module.LeRobotDataset = Written
    for name in ("lerobot", "lerobot.datasets"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)


def written(runs: Any, folder: Path, *names: Any, **more: Any) -> Any:
    return neuros.datasets.lerobot(runs, folder, *names, task="move", **more)


@pytest.mark.usefixtures("lerobot")
def test_lerobot_gets_an_episode_for_each_run(run: Path, tmp_path: Path) -> None:
    made = written([run, run], tmp_path / "new", [POSE, CAMERA], COMMAND, fps=20, robot_type="toy")
    expected = neuros.datasets.steps(run, [POSE, CAMERA], COMMAND)
    count = len(expected)
    assert made.is_final
    assert (made.fps, made.repo_id) == (20, "neuros/recorded")
    options = {"root": tmp_path / "new", "use_videos": False, "robot_type": "toy"}
    assert made.options == options
    assert made.episodes == [count, 2 * count]
    names = [f"{POSE}[{place}]" for place in range(3)]
    assert made.features["observation.state"] == {
        "dtype": "float32", "shape": (3,), "names": names
    }  # fmt: skip
    assert made.features["action"]["names"] == [COMMAND]
    assert made.features["observation.images.robot_camera"]["shape"] == (2, 1, 3)
    for frame, pose in zip(made.frames, [*expected.observation[POSE]] * 2, strict=True):
        assert frame["observation.state"].tolist() == pose.tolist()
        assert frame["action"].tolist() == [10 * pose[0]]
        assert frame["observation.images.robot_camera"][0, 0].tolist() == [255, 0, pose[0]]
        assert frame["task"] == "move"


@pytest.mark.usefixtures("lerobot")
def test_lerobot_is_not_given_what_it_would_break_at(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="exists already"):
        written(run, tmp_path, POSE, COMMAND, fps=20)
    with pytest.raises(UsageError, match="give fps"):
        written(run, tmp_path / "new", POSE, COMMAND)
    assert not (tmp_path / "new").exists()


def test_without_lerobot_it_is_named(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(EnvironmentFault, match="pip install lerobot"):
        written(run, tmp_path / "new", POSE, COMMAND, fps=20)


@pytest.mark.parametrize(
    ("times_s", "rate"),
    [([0, 0.05, 0.1, 0.15], 20), ([0, 1.0, 2.2, 3.2], 1), ([0, 0.05, 0.3], None), ([0], None),
     ([0, 0.0133, 0.0266], 75), ([0, 3, 6], None)],
)  # fmt: skip
def test_a_rate_is_that_of_steady_steps(times_s: list[float], rate: int | None) -> None:
    steps = neuros.datasets.Steps({}, {}, np.array(times_s))
    if rate is None:
        with pytest.raises(UsageError, match="give fps"):
            neuros.datasets._whole_rate(steps)
    else:
        assert neuros.datasets._whole_rate(steps) == rate
