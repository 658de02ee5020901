"""Requirements of this machine for an installation, and commands that install what is missing."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from neuros.errors import EnvironmentFault

OLDEST, NEWEST, NEWEST_FOR_NEST = (3, 10), (3, 14), (3, 13)

OPENGL_PACKAGES = "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libgles2 libosmesa6"
"""Packages of Debian and Ubuntu that render simulated cameras without a display."""
_FEDORA_OPENGL = "mesa-libEGL mesa-libGL mesa-dri-drivers libglvnd-gles"
_OPENGL = {
    # libEGL makes contexts; one of three other libraries draws in them.
    "egl": (("libEGL.so.1",), ("libOpenGL.so.0", "libGL.so.1", "libGLESv2.so.2")),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),),
}

IN_DOCKER = (
    'docker run --rm -it --platform linux/amd64 -v "$PWD":/neuros -w /neuros python:3.12 bash'
)
"""A shell where packages exist; another processor emulates it slowly."""


@dataclass(frozen=True)
class Machine:
    """The facts that decide whether packages of ROS 2 exist for a Python."""

    python: tuple[int, int]
    implementation: str
    system: str
    processor: str
    glibc: tuple[int, ...]
    """Empty with another C library."""

    @classmethod
    def here(cls) -> Machine:
        """The machine, and the Python, that this runs on."""
        libc, version = platform.libc_ver()
        return cls(
            python=sys.version_info[:2],
            implementation=platform.python_implementation(),
            system=platform.system(),
            processor=platform.machine() if sys.maxsize > 2**32 else "a 32-bit Python",
            glibc=tuple(map(int, re.findall(r"\d+", version))) if libc == "glibc" else (),
        )

    def require_support(self) -> None:
        """Raise ``EnvironmentFault`` where no packages can exist.

        For ARM (aarch64) the package index decides at the installation.
        """
        if self.system != "Linux" or self.processor not in ("x86_64", "aarch64"):
            raise EnvironmentFault(
                "the Python packages of ROS 2 exist for Linux on 64-bit processors of the kinds"
                f" x86_64 and aarch64 at most, and this is {self.system} on {self.processor}: use"
                f" Docker, {IN_DOCKER}"
            )
        if self.glibc < (2, 28):
            raise EnvironmentFault(
                "the Python packages of ROS 2 need glibc 2.28 or newer (Debian 10, Ubuntu 20.04), "
                f"which this system does not have: use Docker, {IN_DOCKER}"
            )
        if self.implementation != "CPython" or not OLDEST <= self.python <= NEWEST:
            raise EnvironmentFault(
                f"NeuROS needs CPython {dotted(OLDEST)} to {dotted(NEWEST)}, and this is "
                f"{self.implementation} {dotted(self.python)}: run {other_python()} install.py"
            )


def clean_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment in which the Python of ``.venv`` finds only its own packages.

    Otherwise a sourced ROS 2, or the ``.venv`` of a parent, would come first.
    """
    foreign = {"LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "AMENT_PREFIX_PATH"}
    foreign |= {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "RMW_IMPLEMENTATION"}
    foreign |= {"PIP_TARGET", "PIP_PREFIX", "PIP_USER", "PIP_ROOT"}
    return {key: value for key, value in environment.items() if key not in foreign}


def answer_of(
    command: Sequence[str], environ: Mapping[str, str] | None = None, timeout_s: float | None = None
) -> subprocess.CompletedProcess[str] | None:
    """Run a program without input; ``None`` if it cannot be started, or after ``timeout_s``."""
    try:
        return subprocess.run(
            command,
            env=environ,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None


def explain_missing_library(text: str) -> str:
    """Add the remedy to a message about a missing shared library; return others unchanged."""
    missing = re.search(r"(lib[\w.+-]+): cannot open shared object", text)
    if not missing:
        return text
    remedy = system_install(
        apt=f"{OPENGL_PACKAGES} libgomp1 libstdc++6", dnf=f"{_FEDORA_OPENGL} libgomp libstdc++"
    )
    return f"{text}; {missing.group(1)} belongs to the operating system: {remedy}"


def system_install(*, apt: str, dnf: str) -> str:
    """The command that installs packages of the operating system."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    if shutil.which("apt-get"):
        return f"{sudo}apt-get install -y {apt}"
    if shutil.which("dnf"):
        return f"{sudo}dnf install -y {dnf}"
    return f"install what Debian calls {apt}"


def offscreen_opengl() -> str:
    """The OpenGL for cameras without a display: ``"egl"``, else ``"osmesa"``, else ``""``."""

    def is_there(name: str) -> bool:
        try:
            return bool(ctypes.CDLL(name))
        except OSError:
            return False

    for backend, needed in _OPENGL.items():
        if all(any(map(is_there, names)) for names in needed):
            return backend
    return ""


def install_opengl() -> str:
    """The command that installs what :func:`offscreen_opengl` looks for."""
    return system_install(apt=OPENGL_PACKAGES, dnf=_FEDORA_OPENGL)


def other_python() -> str:
    """A supported Python that is on the path, or the one to install."""
    names = [f"python3.{minor}" for minor in range(NEWEST_FOR_NEST[1], OLDEST[1] - 1, -1)]
    return next((name for name in names if shutil.which(name)), "python3.12")


def dotted(version: tuple[int, ...]) -> str:
    """``(3, 12)`` as ``3.12``."""
    return ".".join(map(str, version))
