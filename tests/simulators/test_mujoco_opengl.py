"""Cameras without a display: with EGL, and where that is missing with OSMesa.

Which of the two it is, is decided once per process (PyOpenGL), so each has a process of its own.
Libraries are hidden from such a process, as on a machine that does not have them.
"""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from neuros.doctor.checks import prove_rendering
from neuros.installation import machine
from neuros.ports import FindingState
from neuros.simulators.mujoco import cameras

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 60.0
CHOICES = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")  # MuJoCo sets the second from the first
EGL = ("EGL",)
WHAT_EGL_DRAWS_WITH = ("GL", "OpenGL", "GLESv1_CM", "GLESv2")
OSMESA = ("OSMesa",)

# Python imports a module of this name at its start.
SITE = """
import ctypes

HIDDEN = {hidden!r}
load = ctypes.CDLL.__init__

def init(self, name, *arguments, **more):
    if any(str(name).rpartition("/")[2].startswith(f"lib{{hidden}}.so") for hidden in HIDDEN):
        raise OSError(f"{{name}}: cannot open shared object file: No such file or directory")
    load(self, name, *arguments, **more)

ctypes.CDLL.__init__ = init
"""
CAMERA = """
import sys
sys.path.insert(0, sys.argv[1])
from simulated_node import WORLD, SimulatedNode
from neuros.simulators.mujoco import MuJoCo

keys = {"sensor": "camera", "element": "eye", "rate": 10, "width": 40, "height": 30}
node = SimulatedNode({"image": ("sensor_msgs/msg/Image", keys)})
sim = MuJoCo(node, WORLD)
print("made", file=sys.stderr)
sim.step_to_next()
image = sim.read("image")
node.close()
sys.stderr.write(next(name for name in ("egl", "osmesa") if f"mujoco.{name}" in sys.modules))
sys.stdout.buffer.write(image.data.tobytes())
"""
NO_CAMERA = """
import sys

class NoOpenGL:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "OpenGL":
            raise RuntimeError("PyOpenGL is imported")

sys.meta_path.insert(0, NoOpenGL())
sys.path.insert(0, sys.argv[1])
from simulated_node import WORLD, SimulatedNode, imu
from neuros.simulators.mujoco import MuJoCo

node = SimulatedNode({"imu": imu("box")})
sim = MuJoCo(node, WORLD)
sim.step_to_next()
print(sim.read("imu").header.stamp.nanosec)
sim.run_asynchronous(None)
node.wait_until(lambda: node.sent)
node.close()
assert not node.failures
assert not [name for name in sys.modules if name.partition(".")[0] == "OpenGL"]
"""


def run(
    program: str, folder: Path, hidden: Sequence[str] = (), **environment: str
) -> subprocess.CompletedProcess[bytes]:
    """Run a program from which libraries are ``hidden``."""
    clean = {key: value for key, value in os.environ.items() if key not in CHOICES}
    command = [sys.executable, "-c", program, str(ROOT / "tests/support")]
    environment = {**clean, **without(hidden, folder), **environment}
    return subprocess.run(
        command, env=environment, capture_output=True, timeout=DEADLINE_S, check=False
    )


def without(hidden: Sequence[str], folder: Path) -> dict[str, str]:
    """The variables of a process from which libraries are hidden."""
    (folder / "sitecustomize.py").write_text(SITE.format(hidden=tuple(hidden)), "utf-8")
    return {"PYTHONPATH": str(folder)}


def image_from(backend: str, folder: Path, hidden: Sequence[str] = (), **environment: str) -> bytes:
    """The picture of the test's world, 40 x 30 RGB, rendered with ``backend``."""
    done = run(CAMERA, folder, hidden, **environment)
    assert done.returncode == 0, done.stderr.decode()
    # OSMesa complains at the exit if its context was not freed.
    assert done.stderr.decode() == f"made\n{backend}"
    return done.stdout


def needs(backend: str) -> None:
    """Skip where a library is not installed; in CI EGL is (Mesa 25.1 and later has no OSMesa)."""
    for name in machine._OPENGL[backend][0]:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return
    if "CI" in os.environ and backend == "egl":
        pytest.fail(f"{backend} is not installed, but CI has to test it")
    pytest.skip(f"{backend} is not installed")


@pytest.mark.parametrize(("backend", "chosen"), [("egl", {}), ("osmesa", {"MUJOCO_GL": "osmesa"})])
def test_a_camera_sees_the_red_floor_below_the_sky(
    backend: str, chosen: dict[str, str], tmp_path: Path
) -> None:
    needs(backend)
    image = image_from(backend, tmp_path, **chosen)
    assert len(image) == 40 * 30 * 3
    top, bottom = image[:120], image[-120:]
    assert sum(bottom[0::3]) > 2 * sum(bottom[1::3]) > 0
    assert sum(top[0::3]) <= sum(top[2::3])


@pytest.mark.parametrize("hidden", [EGL, WHAT_EGL_DRAWS_WITH])
def test_osmesa_is_chosen_where_egl_is_not_or_cannot_draw(
    hidden: tuple[str, ...], tmp_path: Path
) -> None:
    needs("osmesa")
    assert any(image_from("osmesa", tmp_path, hidden))


def test_a_choice_of_the_user_is_respected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert cameras.choose_opengl() == "glfw"


@pytest.mark.parametrize("chosen", [{}, {"MUJOCO_GL": "egl"}])
def test_a_simulation_without_cameras_imports_no_opengl(
    chosen: dict[str, str], tmp_path: Path
) -> None:
    """Not even the one that the user names, which MuJoCo itself imports at once."""
    done = run(NO_CAMERA, tmp_path, (*EGL, *WHAT_EGL_DRAWS_WITH, *OSMESA), **chosen)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout == b"20000000\n"


@pytest.mark.parametrize(
    ("hidden", "chosen"),
    [
        ((*WHAT_EGL_DRAWS_WITH, *OSMESA), {}),
        (WHAT_EGL_DRAWS_WITH, {"MUJOCO_GL": "egl"}),
        (OSMESA, {"MUJOCO_GL": "osmesa"}),
    ],
)
def test_a_camera_that_cannot_render_names_the_packages_before_the_first_step(
    hidden: tuple[str, ...], chosen: dict[str, str], tmp_path: Path
) -> None:
    done = run(CAMERA, tmp_path, hidden, **chosen)
    assert b"made" not in done.stderr
    last = done.stderr.decode().splitlines()[-1]
    assert "EnvironmentFault: a camera cannot render: no usable OpenGL" in last
    assert last.endswith(machine.install_opengl())
    assert all(f"with MUJOCO_GL={name}" in last for name in chosen.values())


class TestDoctor:
    """``neuros doctor`` renders a picture before it says that cameras can."""

    def test_a_picture_was_rendered(self) -> None:
        needs("egl")
        finding = prove_rendering({})
        assert finding.state is FindingState.GOOD
        assert finding.text.startswith("a picture was rendered with EGL (")

    def test_opengl_that_does_not_work_is_a_problem_with_its_remedy(self, tmp_path: Path) -> None:
        needs("egl")
        finding = prove_rendering({**without(WHAT_EGL_DRAWS_WITH + OSMESA, tmp_path)})
        assert finding.state is FindingState.BAD
        assert finding.text.startswith("a camera cannot render: no usable OpenGL (")
        assert machine.OPENGL_PACKAGES in finding.text

    def test_opengl_that_is_not_there_need_not_be(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("neuros.doctor.checks.offscreen_opengl", lambda: "")
        finding = prove_rendering(without(EGL + OSMESA, tmp_path))
        assert finding.state is FindingState.ABSENT
        assert "neither EGL" in finding.text


def test_whoever_names_one_of_the_packages_names_all() -> None:
    """The list itself stands in ``neuros.installation.machine``."""
    packages = set(machine.OPENGL_PACKAGES.split())
    places = ("README.md", "install.py", ".ci/*", "containers/*/*", "docs/*.md", "neuros/**/*.py")
    files = [file for place in places for file in ROOT.glob(place) if file.is_file()]
    words = {file: set(re.findall(r"[\w+.-]+", file.read_text("utf-8"))) for file in files}
    naming = {file.relative_to(ROOT).as_posix() for file in files if "libegl1" in words[file]}
    assert {"containers/neuros_mujoco/Dockerfile", "docs/simulators.md"} <= naming
    assert [file for file in naming if not packages <= words[ROOT / file]] == []
