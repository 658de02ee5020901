"""Checks of Python, packages, memory, ROS domain, display, OpenGL and Docker on this machine."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from enum import Enum
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from neuros.backends.domain import choose_domain
from neuros.backends.placement import usable_cores
from neuros.errors import EnvironmentFault, UsageError
from neuros.installation.machine import Machine, install_opengl, offscreen_opengl

SHARED_MEMORY = Path("/dev/shm")
_LEAST_SHARED_BYTES = 64 * 2**20
"""What Docker gives a container, too, if it is not asked for more."""
_EXTRAS = (
    ("MuJoCo", "mujoco", "./install.py --extras mujoco"),
    ("NEST", "nest-simulator", "./install.py --extras nest"),
    ("Matplotlib", "matplotlib", "./install.py --extras plot"),
)
_GPU_TIMEOUT_S = 10.0
_RENDERING_TIMEOUT_S = 60.0


class State(Enum):
    """How good a finding is."""

    GOOD = "ok"
    ABSENT = "-"
    """Something that is not there and need not be."""
    BAD = "PROBLEM"


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        subject: what was looked at, "Python".
        text: what was found.
        remedy: what to do about it, where there is something to do.
    """

    state: State
    subject: str
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        remedy = f": {self.remedy}" if self.remedy else ""
        return f"{self.state.value:<8} {self.subject:<12} {self.text}{remedy}"


def good(subject: str, text: str) -> Finding:
    """It is as it should be."""
    return Finding(State.GOOD, subject, text)


def absent(subject: str, text: str, remedy: str = "") -> Finding:
    """It is not there, and projects run without it."""
    return Finding(State.ABSENT, subject, text, remedy)


def bad(subject: str, text: str, remedy: str = "") -> Finding:
    """Projects do not run, or not well, because of it."""
    return Finding(State.BAD, subject, text, remedy)


def look_at_machine(environ: Mapping[str, str]) -> Iterator[Finding]:
    """All findings about this machine, one after another."""
    yield _python()
    yield _package("ROS 2", "ros-jazzy-rclpy") or bad("ROS 2", "not installed", "run ./install.py")
    for subject, distribution, remedy in _EXTRAS:
        yield _package(subject, distribution) or absent(subject, "not installed", remedy)
    yield good("cores", f"{len(usable_cores())} usable")
    yield _shared_memory(SHARED_MEMORY)
    yield _domain(environ)
    yield _display(environ)
    yield _gpu()


def _python() -> Finding:
    text = f"{platform.python_version()} ({sys.executable})"
    try:
        Machine.here().require_support()
    except EnvironmentFault as fault:
        return bad("Python", text, str(fault))
    return good("Python", text)


def _package(subject: str, distribution: str) -> Finding | None:
    """``None`` if it is not installed."""
    try:
        return good(subject, f"{distribution} {metadata.version(distribution)}")
    except metadata.PackageNotFoundError:
        return None


def _shared_memory(folder: Path) -> Finding:
    subject = "memory"
    if not os.access(folder, os.W_OK | os.X_OK):
        return bad(
            subject,
            f"{folder} cannot be written",
            "packets go between processes through it; mount a tmpfs there",
        )
    free_bytes = shutil.disk_usage(folder).free
    text = f"{free_bytes / 2**20:.0f} MiB free in {folder}"
    if free_bytes < _LEAST_SHARED_BYTES:
        return bad(subject, text, "images need more; end other runs, or mount it larger")
    return good(subject, text)


def _domain(environ: Mapping[str, str]) -> Finding:
    try:
        with choose_domain(None, environ, False) as domain:
            return good("domain", f"{domain.reason} would be used")
    except (EnvironmentFault, UsageError) as error:
        return bad("domain", str(error))


def _display(environ: Mapping[str, str]) -> Finding:
    for variable in ("WAYLAND_DISPLAY", "DISPLAY"):
        if environ.get(variable):
            return good("display", f"{variable}={environ[variable]}")
    return absent("display", "none; figures go to files, and viewers do not open")


def prove_rendering(environ: Mapping[str, str]) -> Finding:
    """Render one picture with the OpenGL that simulated cameras would use."""
    subject = "cameras"
    if find_spec("mujoco") is None:
        return absent(subject, "not tried without MuJoCo")
    program = "from neuros.simulators.mujoco import cameras; exit(cameras.render_one_picture())"
    command = [sys.executable, "-c", program]
    try:
        done = subprocess.run(
            command,
            env=dict(environ),
            capture_output=True,
            text=True,
            timeout=_RENDERING_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return bad(subject, f"no picture after {_RENDERING_TIMEOUT_S:g} s", install_opengl())
    if done.returncode == 0:
        return good(subject, f"a picture was rendered with {done.stdout.strip()}")
    rows = done.stderr.strip().splitlines() or [f"rendering ends with {done.returncode}"]
    is_expected = bool(environ.get("MUJOCO_GL") or offscreen_opengl())
    return (bad if is_expected else absent)(subject, rows[-1])


def _gpu() -> Finding:
    program = shutil.which("nvidia-smi")
    if program is None:
        return absent("GPU", "no nvidia-smi; everything runs on the processor")
    command = [program, "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=_GPU_TIMEOUT_S, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        return bad("GPU", f"nvidia-smi fails ({error})", "mend the driver")
    return good("GPU", "; ".join(answer.stdout.split("\n")).strip("; "))


def look_at_containers(names: Sequence[str], environ: Mapping[str, str]) -> Iterator[Finding]:
    """The engine and, if it answers, the images of containers of NeuROS's own."""
    if find_spec("docker") is None:
        yield absent("Docker", "its Python package is not installed", "run ./install.py")
        return
    from neuros.backends.docker.engine import connect, engine_faults
    from neuros.backends.docker.images import image_for

    try:
        engine = connect(environ)
    except EnvironmentFault as fault:
        yield absent("Docker", str(fault))
        return
    with closing(engine):
        try:
            with engine_faults("the engine"):
                version = engine.version()
            yield good("Docker", f"engine {version['Version']}, API {version['ApiVersion']}")
        except EnvironmentFault as fault:
            yield bad("Docker", str(fault))
            return
        for name in names:
            try:
                image = image_for(name, None, engine)
            except EnvironmentFault as fault:
                yield absent("image", str(fault))
                continue
            python = "{}.{}".format(*image.python_version)
            if image.notice:
                yield absent("image", image.notice)
            else:
                yield good("image", f"{image.name}, Python {python}")
