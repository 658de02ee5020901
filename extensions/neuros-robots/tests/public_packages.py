"""Robots that packages of PyPI ship: nobody here wrote them.

They are downloaded once, into the user's cache. Without a registry the tests on them are skipped.
"""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from functools import cache
from pathlib import Path

import pytest

_FINGERS = "robot_properties_fingers/urdf"
PACKAGES = {  # small ones: 20 MB in all
    "jvrc-description==1.1.1": ["jvrc_description/urdf/jvrc1.urdf"],
    "robot-properties-fingers==2.0.2": [
        f"{_FINGERS}/edu/trifingeredu.urdf",
        f"{_FINGERS}/finger_with_stage.urdf",
        f"{_FINGERS}/pro/fingerpro.urdf",
        f"{_FINGERS}/trifinger.urdf",
    ],
    "gym-ignition-models==1.1.1": [
        "gym_ignition_models/cartpole/cartpole.urdf",
        "gym_ignition_models/character/character.urdf",
        "gym_ignition_models/iCubGazeboV2_5/icub.urdf",
        "gym_ignition_models/panda/panda.urdf",
    ],
}
"""Robots whose meshes their packages ship."""
_MOST_S = 120


@cache
def unpacked(requirement: str) -> Path:
    """The folder of a package's files; the test is skipped where no registry is reached."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neuros-tests"
    folder = base / requirement
    if not folder.is_dir():
        download = base / "download" / str(os.getpid())
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--retries=0"]
        try:
            subprocess.run(
                [*command, "--dest", str(download), requirement],
                check=True,
                capture_output=True,
                timeout=_MOST_S,
            )
        except (subprocess.SubprocessError, OSError):
            pytest.skip(f"{requirement} cannot be downloaded: no registry is reached")
        (wheel,) = download.glob("*.whl")
        made = download / "files"
        with zipfile.ZipFile(wheel) as files:
            files.extractall(made)
        wheel.unlink()
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            made.rename(folder)
        except OSError:  # another process was faster
            assert folder.is_dir()
    return folder


each_robot = pytest.mark.parametrize(
    ("requirement", "name"),
    [(requirement, name) for requirement, names in PACKAGES.items() for name in names],
)
