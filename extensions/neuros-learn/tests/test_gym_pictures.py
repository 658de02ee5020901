"""Pictures of environments: frames and videos by the cameras of a project."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo, RenderCollection
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_msgs.msg import Image

import neuros.gym
from neuros.errors import UsageError

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "7_learning" / "cartpole"
WIDTH, HEIGHT = 64, 48
JOINTS = "cart.joints.position[2]"
NO_INFINITY = ".*Box observation space m.* is .*infinity"
SIDE = '<light pos="0 -3 3"/><camera name="side" pos="0 -3 0.5" xyaxes="1 0 0 0 0 1"/>'


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    warnings.filterwarnings("ignore", NO_INFINITY)
    warnings.filterwarnings("ignore", ".* is not connected")


def film(folder: Path, *names: str, rate: float = 25) -> Path:
    """The example, with cameras that look at the cart from the side; joints have 50 Hz."""
    made = shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("runs"))
    model = (made / "cart.xml").read_text()
    (made / "cart.xml").write_text(model.replace("<worldbody>", f"<worldbody>{SIDE}"))
    node = json.loads((made / "cart.json").read_text())
    camera = {"sensor": "camera", "element": "side", "width": WIDTH, "height": HEIGHT, "rate": rate}
    node["outputs"] += [
        {"name": name, "type": "sensor_msgs/msg/Image", "mujoco": camera} for name in names
    ]
    (made / "cart.json").write_text(json.dumps(node))
    outputs = ", ".join(f"Optional({name!r})" for name in names)
    packets = ", ".join(f"simulator.read({name!r})" for name in names)
    hooks = (made / "cart.py").read_text()
    hooks = hooks.replace('outputs="joints"', f'outputs=["joints", {outputs}]')
    hooks = hooks.replace(
        'return simulator.read("joints")', f'return simulator.read("joints"), {packets}'
    )
    (made / "cart.py").write_text(hooks.replace("import neuros_f", "import Optional, neuros_f"))
    return made


def cart_pole(folder: Path, **others: Any) -> gymnasium.Env[Any, Any]:
    arguments: dict[str, Any] = {
        "action": "policy.force",
        "observation": JOINTS,
        "reward": lambda: 1.0,
        "model": "cart.xml",
        "max_episode_steps": 10,
    }
    return neuros.gym.make(folder, **(arguments | others))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("filmed") / "cartpole", "camera")


@pytest.fixture(scope="module")
def env(
    filmed: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[gymnasium.Env[Any, Any]]:
    made = cart_pole(filmed, render_mode="rgb_array", output=tmp_path_factory.mktemp("gym") / "run")
    yield made
    made.close()


def test_a_frame_is_the_newest_picture_of_the_only_camera(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=1)
    frames = [env.render()]
    for _ in range(3):
        env.step(np.array([1.0]))
        frames.append(env.render())
    assert {(each.shape, each.dtype.name) for each in frames} == {((HEIGHT, WIDTH, 3), "uint8")}
    # Joints come every 20 ms, pictures every 40 ms: the first frame is from before the first one.
    assert not frames[0].any()
    assert frames[1].any()
    assert (frames[1] == frames[2]).all()
    assert (frames[2] != frames[3]).any()


def test_a_frame_is_its_owners(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=1)
    env.step(np.array([1.0]))
    kept = env.render().copy()
    env.render()[:] = 7
    assert (env.render() == kept).all()


def test_rendering_changes_no_episode(env: gymnasium.Env[Any, Any], filmed: Path) -> None:
    plain = cart_pole(filmed)
    try:
        for each in (env, plain):
            each.reset(seed=3)
        for _ in range(5):
            env.render()
            assert env.step(np.array([0.5]))[0].tolist() == plain.step(np.array([0.5]))[0].tolist()
    finally:
        plain.close()


def test_a_step_is_a_frame_of_a_video(env: gymnasium.Env[Any, Any]) -> None:
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 50}


@pytest.mark.parametrize(
    ("length", "fps"),
    [({"rounds": 2}, 25), ({"sim_s": 0.05}, 20), ({"sim_s": 0.04}, 25)],
)
def test_longer_steps_give_fewer_frames_per_second(
    filmed: Path, length: dict[str, Any], fps: float
) -> None:
    made = cart_pole(filmed, **length)
    try:
        assert made.metadata["render_fps"] == fps
    finally:
        made.close()


@pytest.mark.acceptance
def test_the_checker_of_gymnasium_finds_no_fault(filmed: Path) -> None:
    made = cart_pole(filmed, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", NO_INFINITY)
        warnings.filterwarnings("ignore", ".* is not connected")
        try:
            check_env(made.unwrapped)
        finally:
            made.close()


def test_the_frames_of_an_episode_are_collected(env: gymnasium.Env[Any, Any]) -> None:
    collected = RenderCollection(env)
    collected.reset(seed=1)
    for _ in range(4):
        collected.step(np.array([0.0]))
    frames: Any = collected.render()
    assert np.shape(frames) == (5, HEIGHT, WIDTH, 3)


@pytest.mark.acceptance
def test_gymnasium_collects_them_for_a_render_mode_of_its_own(filmed: Path) -> None:
    made = cart_pole(filmed, render_mode="rgb_array_list")
    try:
        made.reset(seed=1)
        made.step(np.array([0.0]))
        frames: Any = made.render()
        assert np.shape(frames) == (2, HEIGHT, WIDTH, 3)
    finally:
        made.close()


@pytest.mark.acceptance
def test_a_video_of_an_episode_is_written(env: gymnasium.Env[Any, Any], tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="pip install moviepy")
    from moviepy import VideoFileClip

    film_of = RecordVideo(env, str(tmp_path / "videos"), lambda _: True, disable_logger=True)
    film_of.reset(seed=1)
    is_over = False
    while not is_over:
        *_, terminated, truncated, _ = film_of.step(np.array([0.0]))
        is_over = terminated or truncated
    assert len(film_of.recorded_frames) == 11  # of the reset, and of 10 steps
    film_of.stop_recording()
    with VideoFileClip(str(tmp_path / "videos" / "rl-video-episode-0.mp4")) as clip:
        assert (clip.size, clip.fps) == ([WIDTH, HEIGHT], 50)


@pytest.mark.acceptance
def test_stable_baselines3_writes_one(filmed: Path, tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="pip install moviepy")
    pytest.importorskip("stable_baselines3", reason="pip install torch stable-baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv, VecVideoRecorder

    envs = VecVideoRecorder(
        DummyVecEnv([lambda: cart_pole(filmed, render_mode="rgb_array")]),
        str(tmp_path / "videos"),
        record_video_trigger=lambda step: step == 0,
        video_length=5,
    )
    envs.reset()
    for _ in range(6):
        envs.step(np.array([[0.0]]))
    envs.close()
    (video,) = (tmp_path / "videos").iterdir()
    assert video.stat().st_size > 0


@pytest.mark.acceptance
def test_of_several_cameras_one_is_named(tmp_path: Path) -> None:
    made = film(tmp_path / "two", "left", "right")
    with pytest.raises(UsageError, match=r"has the cameras cart\.left, cart\.right: choose one"):
        cart_pole(made, render_mode="rgb_array")
    assert not (tmp_path / "runs").exists()
    env = cart_pole(made, render_mode="rgb_array", render="cart.right")
    try:
        env.reset(seed=1)
        env.step(np.array([0.0]))
        assert env.render().any()
    finally:
        env.close()


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"render_mode": "rgb_array"}, "no output of cartpole sends sensor_msgs/msg/Image"),
        ({"render": "cart.joints"}, "'cart.joints': the output sends sensor_msgs/msg/JointState"),
        ({"render": "cart.joint"}, r"no such output \(did you mean 'cart\.joints'\?\)"),
    ],
)
def test_a_camera_that_is_none_is_refused_before_anything_starts(
    tmp_path: Path, changed: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(UsageError, match=complaint):
        cart_pole(EXAMPLE, **changed)
    assert not (tmp_path / "runs").exists()


def test_another_render_mode_is_refused(filmed: Path) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*not in the possible render_modes")
        with pytest.raises(UsageError, match="render_mode='ansi': there is 'rgb_array', or None"):
            cart_pole(filmed, render_mode="ansi")


MIRROR = """
from neuros.hooks import Optional, neuros_function

@neuros_function(
    inputs=[Optional("order"), Optional("picture")], outputs=["done", Optional("camera")]
)
def step(node, order, picture):
    return node.make_packet("done"), picture
"""


@pytest.fixture(scope="module")
def mirror(tmp_path_factory: pytest.TempPathFactory) -> Iterator[gymnasium.Env[Any, Any]]:
    """The camera of its node sends the picture that the node was sent."""
    folder = tmp_path_factory.mktemp("mirror")
    (folder / "mirror.py").write_text(MIRROR)
    image, flag = "sensor_msgs/msg/Image", "std_msgs/msg/Bool"
    node = {
        "name": "robot",
        "plugin": "mirror.py",
        "container": "neuros_python",
        "inputs": [{"name": "order", "type": flag}, {"name": "picture", "type": image}],
        "outputs": [{"name": "done", "type": flag}, {"name": "camera", "type": image}],
    }
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* is not connected")
        made = neuros.gym.make(
            folder,
            action="robot.order",
            observation="robot.done",
            reward=lambda: 0.0,
            render_mode="rgb_array",
            output=folder / "run",
        )
    yield made
    made.close()


def frame_of(mirror: Any, image: Image) -> Any:
    mirror.session.send("robot.picture", image)
    mirror.step(np.array([0]))
    return mirror.render()


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_colours_and_sizes_of_pictures_are_kept(mirror: Any, data: st.DataObject) -> None:
    encoding = data.draw(st.sampled_from(["rgb8", "bgr8", "mono8"]))
    height, width, spare = (data.draw(st.integers(n, 6)) for n in (1, 1, 0))
    colours = np.array(
        data.draw(
            st.lists(
                st.tuples(*[st.integers(0, 255)] * 3),
                min_size=height * width,
                max_size=height * width,
            )
        ),
        np.uint8,
    ).reshape(height, width, 3)
    if encoding == "mono8":
        colours = colours[..., :1].repeat(3, axis=2)
        rows = colours[..., 0]
    else:
        rows = (colours if encoding == "rgb8" else colours[..., ::-1]).reshape(height, 3 * width)
    padded = np.pad(rows, ((0, 0), (0, spare)))
    image = Image(height=height, width=width, encoding=encoding, step=padded.shape[1])
    image.data = padded.tobytes()
    frame = frame_of(mirror, image)
    assert frame.dtype == np.uint8
    assert frame.tolist() == colours.tolist()


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"encoding": "32FC1"}, "images with encoding 32FC1 cannot be drawn: rgb8, bgr8, mono8"),
        ({"encoding": "rgb8", "width": 9}, "4 bytes are not an image of 9 x 2"),
        ({"encoding": "mono8", "height": 0}, "4 bytes are not an image of 2 x 0"),
    ],
)
def test_a_picture_that_is_none_is_an_error_that_names_its_camera(
    mirror: Any, changed: dict[str, Any], complaint: str
) -> None:
    image = Image(**({"height": 2, "width": 2, "step": 0} | changed))
    image.data = bytes(4)
    with pytest.raises(UsageError, match=f"render: robot.camera: {complaint}"):
        frame_of(mirror, image)


def test_a_camera_whose_size_is_not_known_must_have_sent(mirror: Any) -> None:
    mirror.reset()
    with pytest.raises(
        UsageError, match=r"robot\.camera has sent no picture yet .*hook that begins"
    ):
        mirror.render()


def test_without_a_render_mode_there_is_no_frame_and_a_warning(filmed: Path) -> None:
    made = cart_pole(filmed)
    try:
        with pytest.warns(UserWarning, match="make the environment with render_mode='rgb_array'"):
            assert made.render() is None
    finally:
        made.close()
