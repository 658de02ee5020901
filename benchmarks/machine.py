"""What was measured on: the machine, the versions, and what else the machine was doing."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

_PACKAGES = ("neuros", "ros-jazzy-rclpy", "ros-fastrtps", "mujoco", "nest-simulator", "dora-rs")


def machine() -> dict[str, str]:
    """Processor, number of usable cores, system."""
    return {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "system": platform.platform(),
        "host": platform.node(),
    }


def versions() -> dict[str, str]:
    """Versions of Python, of NeuROS and its commit, and of what it is measured with."""
    found = {"python": platform.python_version(), "commit": _commit()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def load_before(seconds: float = 1.0) -> float:
    """Share of all cores that others keep busy now, by watching them for a while."""
    first = _cpu_times()
    time.sleep(seconds)
    busy, total = (now - then for now, then in zip(_cpu_times(), first, strict=True))
    return busy / total if total else 0.0


def _cpu_times() -> tuple[int, int]:
    """Busy and total time of all cores since the start of the machine (``proc_stat(5)``)."""
    fields = Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
    times = [int(field) for field in fields]
    idle = times[3] + times[4]  # idle and iowait; stolen time counts as busy
    return sum(times) - idle, sum(times)


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str:
    """The commit of the source checkout; "+" behind it: files differ from it."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--abbrev=12", "--dirty=+"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() if done.returncode == 0 else "unknown"
