"""The registered simulators, ours, and what ``neuros doctor`` finds of them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata
from importlib.util import find_spec

from neuros.distribution import install_command
from neuros.installation.machine import install_opengl, offscreen_opengl
from neuros.ports import Finding, SimulatorKind
from neuros.registry import Registry

SIMULATORS: Registry[SimulatorKind] = Registry("neuros.simulators", "simulator", SimulatorKind)

_RENDERING_TIMEOUT_S = 60.0


class _MuJoCo(SimulatorKind):
    name = "mujoco"

    def checks(self, environ: Mapping[str, str]) -> Iterator[Finding]:
        yield installed("MuJoCo", "mujoco", install_command("mujoco"))
        yield prove_rendering(environ)


class _Nest(SimulatorKind):
    name = "nest"

    def checks(self, environ: Mapping[str, str]) -> Iterator[Finding]:
        yield installed("NEST", "nest-simulator", install_command("nest"))


MUJOCO = _MuJoCo()
NEST = _Nest()


def installed(subject: str, distribution: str, remedy: str) -> Finding:
    """The version of a distribution; it is absent if it is not installed."""
    try:
        return Finding.good(subject, f"{distribution} {metadata.version(distribution)}")
    except metadata.PackageNotFoundError:
        return Finding.absent(subject, "not installed", remedy)


def prove_rendering(environ: Mapping[str, str]) -> Finding:
    """Render one picture with the OpenGL that simulated cameras would use."""
    subject = "cameras"
    if find_spec("mujoco") is None:
        return Finding.absent(subject, "not tried without MuJoCo")
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
        return Finding.bad(
            subject, f"no picture after {_RENDERING_TIMEOUT_S:g} s", install_opengl()
        )
    if done.returncode == 0:
        return Finding.good(subject, f"a picture was rendered with {done.stdout.strip()}")
    rows = done.stderr.strip().splitlines() or [f"rendering ends with {done.returncode}"]
    is_expected = bool(environ.get("MUJOCO_GL") or offscreen_opengl())
    return (Finding.bad if is_expected else Finding.absent)(subject, rows[-1])
