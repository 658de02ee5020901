"""A checkout in a ROS workspace: colcon builds it and its messages with the wheels of ROS.

Where those were made, their CMake files name the Python: ``/opt/python/cp311-cp311``. The build has
that folder, as links, in an ``/opt`` of its own. A distribution names no such folder.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from launching import REPOSITORY
from needs import COMPILER, cannot_run

from neuros.installation.packages import find_uv

pytestmark = [pytest.mark.acceptance, pytest.mark.needs("git", *COMPILER)]

TIMEOUT_S = 1800.0
COLCON = ("colcon-common-extensions", "setuptools<79", "cmake<4", "empy<4", "lark")
BUILDERS = (
    *("ament-cmake", "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-include-directories"),
    *("ament-cmake-pytest", "ament-cmake-ros", "ament-package", "python-cmake-module"),
    *("rosidl-core-generators", "rosidl-default-generators", "rosidl-default-runtime"),
)
"""What the wheels of message packages need to be built upon, and do not ask for."""
VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"
TAG = f"cp{VERSION.replace('.', '')}"


def run(command: str, cwd: Path, **environment: str) -> str:
    """The output of a command of bash; the test fails if that does."""
    done = subprocess.run(
        ["bash", "-ec", command],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


def namespace() -> str:
    """The command that gives another one mounts of its own."""
    command = ["unshare", "--mount", *(["--map-root-user"] if os.geteuid() != 0 else [])]
    try:
        subprocess.run([*command, "mount", "-t", "tmpfs", "none", "/opt"], check=True)
    except (OSError, subprocess.CalledProcessError):
        cannot_run("mounts of its own (unshare)")
    return shlex.join(command)


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with colcon, the wheels of ROS, and what NeuROS needs of others."""
    folder = tmp_path_factory.mktemp("colcon") / "venv"
    tomllib = pytest.importorskip("tomllib")  # of Python 3.11
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]
    ros = [f"ros-jazzy-{name}" for name in BUILDERS]
    packages = shlex.join([*project["dependencies"], *COLCON, *ros])
    uv = shlex.quote(str(find_uv(Path(sys.executable))))
    make = f"{uv} venv -q --seed --python {shlex.quote(sys.executable)} {folder}"
    install = f"{uv} pip install -q --python {folder}/bin/python {packages}"
    run(f"{make} && {install}", folder.parent)
    return folder


@pytest.fixture(scope="module")
def workspace(environment: Path) -> Path:
    """A workspace with a clone of this checkout, built."""
    folder = environment.parent / "ws"
    (folder / "src").mkdir(parents=True)
    run(f"git clone -q file://{REPOSITORY} src/neuros", folder)
    wheels = f"/opt/python/{TAG}-{TAG}"
    packages = f"{environment}/lib/python{VERSION}/site-packages"
    links = (
        f"mount -t tmpfs none /opt && mkdir -p {wheels}/include {wheels}/lib/python{VERSION}"
        f" && ln -s {sysconfig.get_path('include')} {wheels}/include/python{VERSION}"
        f" && ln -s {packages} {wheels}/lib/python{VERSION}/site-packages"
    )
    # The wheels have no tf2_msgs, as distributions have: NeuROS builds that itself.
    build = (
        "colcon build --base-paths src src/neuros/workspace --packages-ignore tf2_msgs"
        " --packages-select neuros neuros_msgs --executor sequential"
        f" --cmake-args -DPython3_EXECUTABLE={environment}/bin/python"
    )
    run(
        f"{namespace()} sh -c {shlex.quote(f'{links} && {build}')}",
        folder,
        PATH=f"{environment}/bin:{os.environ['PATH']}",
        AMENT_PREFIX_PATH=str(environment),
        CMAKE_PREFIX_PATH=str(environment),
        PYTHONPATH=packages,
    )
    return folder


def test_colcon_finds_neuros_and_the_packages_of_its_workspace(
    environment: Path, workspace: Path
) -> None:
    listed = run(f"{environment}/bin/colcon list --base-paths src src/neuros/workspace", workspace)
    assert [line.split() for line in listed.splitlines()] == [
        ["neuros", "src/neuros", "(ros.ament_python)"],
        *(
            [name, f"src/neuros/workspace/{name}", f"(ros.{kind})"]
            for name, kind in (
                *(("neuros_msgs", "ament_cmake"), ("tf2_msgs", "neuros")),
                ("whiskeye_msgs", "ament_cmake"),
            )
        ),
    ]


def test_what_was_built_runs_a_project_and_has_the_messages(
    environment: Path, workspace: Path
) -> None:
    sourced = f". install/setup.bash && export PATH={environment}/bin:$PATH"
    code = "import neuros, neuros_msgs.msg; print(neuros.__file__, neuros_msgs.__file__)"
    for file in run(f"{sourced} && python -c '{code}'", workspace).split():
        assert file.startswith(f"{workspace}/install/")
    index = workspace / "install/neuros/share/ament_index/resource_index/packages/neuros"
    assert index.is_file()
    said = run(
        f"{sourced} && install/neuros/lib/neuros/neuros launch src/neuros/examples/1_tick/clock"
        " --duration 3 --backend process 2>&1",
        workspace,
    )
    assert "It is" in said
