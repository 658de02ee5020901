"""Report of ``neuros doctor``: this machine, its back ends, and a proof of delivery.

The proof is a project of two nodes, run as any other. Topics that nodes see prove nothing: shared
memory that is not shared loses each packet in silence. So one node sends images, and the other
answers with their content.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from neuros.api.loading import load_with_messages
from neuros.backends.domain import choose_domain
from neuros.backends.node_command import usable_cores
from neuros.distribution import install_command, python_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.installation.machine import Machine, answer_of, install_opengl, offscreen_opengl
from neuros.ports import Finding, FindingState
from neuros.recording.run_file import read_run_file
from neuros.registry import BACK_ENDS, CHECKS, Part, Registry, option_values
from neuros.stacks import allow_reading, threads_of

PROJECT = Path(__file__).with_name("delivery")
SHARED_MEMORY = Path("/dev/shm")
_LEAST_SHARED_BYTES = 64 * 2**20
"""Docker's default for a container, too."""
_DISPLAYS = ("WAYLAND_DISPLAY", "DISPLAY")
_GPU_TIMEOUT_S = 10.0
_DELIVERY_TIMEOUT_S = 60.0
_RENDERING_TIMEOUT_S = 60.0


def findings(environ: Mapping[str, str], *, proves: bool) -> Iterator[Finding]:
    """All findings, one after another.

    Args:
        proves: whether to start nodes on each back end that can be used.
    """
    yield from look_at_machine(environ)
    yield from look_at_simulators(environ)
    checks, broken_checks = _parts(CHECKS)
    back_ends, broken_back_ends = _parts(BACK_ENDS)
    yield from (*broken_checks, *broken_back_ends)
    for check in checks:
        yield from check.checks(environ)
    for back_end in back_ends:
        yield from back_end.checks(environ)
    if not proves:
        return
    project = load_with_messages(PROJECT)[0].project
    for back_end in sorted(back_ends, key=lambda each: each.rank or 0):
        try:
            back_end.prepare(project, project.nodes, option_values(back_end, {}))
        except EnvironmentFault as fault:
            yield Finding.absent(
                "delivery", f"{back_end.name}: not tried: {back_end.why_not(fault)}"
            )
        else:
            yield prove_delivery(back_end.name)


def _parts(registry: Registry[Part]) -> tuple[list[Part], list[Finding]]:
    """The parts of a registry that can be loaded, and findings about the others."""
    loaded: list[Part] = []
    broken: list[Finding] = []
    try:
        for name in registry:
            try:
                loaded.append(registry.load(name))
            except EnvironmentFault as fault:
                broken.append(Finding.bad(registry.noun, str(fault)))
    except EnvironmentFault as fault:  # two distributions share a name
        broken.append(Finding.bad(registry.noun, str(fault)))
    return loaded, broken


def look_at_machine(environ: Mapping[str, str]) -> Iterator[Finding]:
    """All findings about this machine, one after another."""
    yield _python()
    ros = installed("ROS 2", "ros-jazzy-rclpy", f"run {install_command()}")
    yield ros if ros.state is FindingState.GOOD else replace(ros, state=FindingState.BAD)
    yield installed("Matplotlib", "matplotlib", install_command("plot"))
    yield Finding.good("cores", f"{len(usable_cores())} usable")
    yield _shared_memory(SHARED_MEMORY)
    yield _domain(environ)
    allow_reading()
    read = threads_of(os.getpid())  # nodes are children of a launcher, as this process is of one
    if read.threads:
        yield Finding.good("stacks", "those of nodes that hang can be shown")
    else:
        yield Finding.absent("stacks", f"those of nodes that hang cannot be shown: {read.problem}")
    shown = [f"{name}={environ[name]}" for name in _DISPLAYS if environ.get(name)]
    if shown:
        yield Finding.good("display", shown[0])
    else:
        yield Finding.absent("display", "none; figures go to files, and viewers do not open")
    yield _gpu()


def look_at_simulators(environ: Mapping[str, str]) -> Iterator[Finding]:
    """All findings about simulators, one after another."""
    yield installed("MuJoCo", "mujoco", install_command("mujoco"))
    yield prove_rendering(environ)
    yield installed("NEST", "nest-simulator", install_command("nest"))


def _python() -> Finding:
    text = f"{platform.python_version()} ({sys.executable})"
    try:
        Machine.here().require_support()
    except EnvironmentFault as fault:
        return Finding.bad("Python", text, str(fault))
    return Finding.good("Python", text)


def _shared_memory(folder: Path) -> Finding:
    subject = "memory"
    if not os.access(folder, os.W_OK | os.X_OK):
        return Finding.bad(
            subject,
            f"{folder} cannot be written",
            "packets go between processes through it; mount a tmpfs there",
        )
    free_bytes = shutil.disk_usage(folder).free
    text = f"{free_bytes / 2**20:.0f} MiB free in {folder}"
    if free_bytes < _LEAST_SHARED_BYTES:
        return Finding.bad(subject, text, "images need more; end other runs, or mount it larger")
    return Finding.good(subject, text)


def _domain(environ: Mapping[str, str]) -> Finding:
    try:
        with choose_domain(None, environ, False) as domain:
            return Finding.good("domain", f"{domain.reason} would be used")
    except (EnvironmentFault, UsageError) as error:
        return Finding.bad("domain", str(error))


def _gpu() -> Finding:
    program = shutil.which("nvidia-smi")
    if program is None:
        return Finding.absent("GPU", "no nvidia-smi; everything runs on the processor")
    command = [program, "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=_GPU_TIMEOUT_S, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        return Finding.bad("GPU", f"nvidia-smi fails ({error})", "mend the driver")
    return Finding.good("GPU", "; ".join(answer.stdout.split("\n")).strip("; "))


def installed(subject: str, distribution: str, remedy: str) -> Finding:
    try:
        return Finding.good(subject, f"{distribution} {metadata.version(distribution)}")
    except metadata.PackageNotFoundError:
        return Finding.absent(subject, "not installed", remedy)


def prove_rendering(environ: Mapping[str, str]) -> Finding:
    """Render one picture with the OpenGL of simulated cameras."""
    subject = "cameras"
    if find_spec("mujoco") is None:
        return Finding.absent(subject, "not tried without MuJoCo")
    program = "from neuros.simulators.mujoco import cameras; exit(cameras.render_one_picture())"
    done = answer_of(python_command(code=program), environ, _RENDERING_TIMEOUT_S)
    if done is None:
        return Finding.bad(
            subject, f"no picture after {_RENDERING_TIMEOUT_S:g} s", install_opengl()
        )
    if done.returncode == 0:
        return Finding.good(subject, f"a picture was rendered with {done.stdout.strip()}")
    rows = done.stderr.strip().splitlines() or [f"rendering ends with {done.returncode}"]
    is_expected = bool(environ.get("MUJOCO_GL") or offscreen_opengl())
    return (Finding.bad if is_expected else Finding.absent)(subject, rows[-1])


def prove_delivery(
    backend: str, project: Path = PROJECT, *, options: Sequence[str] = (), where: str = ""
) -> Finding:
    """Run the project on a back end; it ends by itself when all images have come back.

    Args:
        options: further options of ``neuros launch``.
        where: subject of the finding, if not the back end.
    """
    subject, name = "delivery", where or backend
    with tempfile.TemporaryDirectory(prefix="neuros-doctor-") as folder:
        run = Path(folder) / "run"
        command = python_command("neuros.cli", "launch", str(project))
        command += ["--backend", backend, "-o", str(run), *options]
        with subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as launcher:
            try:
                output, _ = launcher.communicate(timeout=_DELIVERY_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                launcher.terminate()
                output, _ = launcher.communicate()
                return Finding.bad(
                    subject, f"{name}: no end after {_DELIVERY_TIMEOUT_S:g} s", _last(output)
                )
            except BaseException:
                launcher.terminate()
                raise
        if launcher.returncode:
            return Finding.bad(subject, f"{name}: failed", _last(output))
        return _judge(name, read_run_file(run))


def _judge(backend: str, record: dict[str, object]) -> Finding:
    connections = record["connections"]
    assert isinstance(connections, list)
    counts = [f"{c['consumed']} of {c['sent']} on {c['connection']}" for c in connections]
    is_whole = all(c["sent"] and c["consumed"] == c["sent"] for c in connections)
    text = f"{backend}: packets arrived: {', '.join(counts)}"
    return (Finding.good if is_whole else Finding.bad)("delivery", text)


def _last(output: str) -> str:
    """The last line of the launcher, which has the reason of its end."""
    rows = [row for row in output.splitlines() if row.strip()]
    return rows[-1] if rows else "it said nothing"
