"""Cameras without a display: with EGL, and where that is missing with OSMesa.

Which of the two it is, is decided once per process (PyOpenGL), so each has a process of its own.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from neuros.simulators.mujoco import opengl

DEADLINE_S = 60.0
CHOICES = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")  # MuJoCo sets the second from the first

PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from simulated_node import WORLD, SimulatedNode
from neuros.simulators.mujoco import MuJoCo
import os

keys = {"sensor": "camera", "element": "eye", "rate": 10, "width": 40, "height": 30}
node = SimulatedNode({"image": ("sensor_msgs/msg/Image", keys)})
sim = MuJoCo(node, WORLD)
sim.step_to_next()
image = sim.read("image")
node.close()
assert os.environ["MUJOCO_GL"] == sys.argv[2], os.environ["MUJOCO_GL"]
sys.stdout.buffer.write(image.data.tobytes())
"""


def image_from(backend: str, **environment: str) -> bytes:
    """The picture of the test's world, 40 x 30 RGB."""
    clean = {key: value for key, value in os.environ.items() if key not in CHOICES}
    program = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), backend]
    done = subprocess.run(
        program, env={**clean, **environment}, capture_output=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    assert done.stderr == b""  # OSMesa complains at the exit if its context was not freed
    return done.stdout


def needs(backend: str) -> None:
    """Skip where a library is not installed; in CI EGL is (Mesa 25.1 and later has no OSMesa)."""
    for name in opengl._LIBRARIES[backend]:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return
    if "CI" in os.environ and backend == "egl":
        pytest.fail(f"{backend} is not installed, but CI has to test it")
    pytest.skip(f"{backend} is not installed")


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_a_camera_sees_the_red_floor_below_the_sky(backend):
    needs(backend)
    image = image_from(backend, MUJOCO_GL=backend)
    assert len(image) == 40 * 30 * 3
    top, bottom = image[:120], image[-120:]
    assert sum(bottom[0::3]) > 2 * sum(bottom[1::3]) > 0
    assert sum(top[0::3]) <= sum(top[2::3])


def test_egl_is_chosen_where_it_is():
    needs("egl")
    assert any(image_from("egl"))


def test_osmesa_is_chosen_where_there_is_no_egl(monkeypatch):
    needs("osmesa")
    monkeypatch.setitem(opengl._LIBRARIES, "egl", ("libnothing-egl.so.1",))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    opengl.choose_opengl()
    assert os.environ.pop("MUJOCO_GL") == "osmesa"


def test_a_choice_of_the_user_is_respected(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    opengl.choose_opengl()
    assert os.environ["MUJOCO_GL"] == "glfw"
