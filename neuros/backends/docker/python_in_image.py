"""Finds the Python of an image, and whether that runs nodes, by running the image once."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from docker import DockerClient
from docker.errors import APIError, NotFound

from neuros.backends.docker.engine import engine_faults
from neuros.errors import EnvironmentFault

OLDEST, NEWEST = (3, 10), (3, 14)

# Of all Pythons of the image the first with rclpy, else the first. A ROS distribution has to be
# sourced for that. The proof is rclpy in use: without its middleware it imports nothing either.
_PROBE = r"""
for setup in /opt/ros/*/setup.sh; do
  [ -f "$setup" ] && . "$setup" && export NEUROS_SETUP="$setup" && break
done
for python in /opt/neuros/bin/python "$VIRTUAL_ENV/bin/python" python3 python; do
  command -v "$python" >/dev/null 2>&1 || continue
  "$python" -c "$PROOF" 2>/dev/null || "$python" -c "$FACTS" 2>/dev/null
done
true
"""
_FACTS = r"""
import json, os, platform, sys
print(json.dumps({"python": sys.executable, "version": list(sys.version_info[:2]),
    "glibc": platform.libc_ver()[0] == "glibc", "machine": platform.machine(),
    "has_rclpy": "rclpy" in sys.modules, "setup": os.environ.get("NEUROS_SETUP", "")}))
"""
_PROOF = f"""
import rclpy, rclpy.utilities
rclpy.utilities.get_rmw_implementation_identifier()
{_FACTS}
"""
_TIMEOUT_S = 120


@dataclass(frozen=True)
class PythonInImage:
    """The Python that nodes would run in.

    Attributes:
        path: of the program.
        version: as ``(3, 12)``.
        has_rclpy: whether rclpy and its middleware load there.
        setup: the shell script of a ROS distribution that has to be sourced first, or "".
    """

    path: str
    version: tuple[int, int]
    has_rclpy: bool
    setup: str = ""

    @property
    def start(self) -> tuple[str, ...]:
        """The command that starts this Python, without arguments."""
        if not self.setup:
            return (self.path,)
        return ("/bin/sh", "-c", f'. {self.setup} && exec "$0" "$@"', self.path)


def python_in(engine: DockerClient, image: str, name: str) -> PythonInImage:
    """Look into an image; ``name`` is for messages.

    Raises:
        EnvironmentFault: if it has no Python that could ever run nodes.
    """
    with engine_faults(f"image '{name}' cannot be looked into"):
        output = _output(engine, image, name)
    return chosen(_facts(output), name)


def chosen(answers: Sequence[Mapping[str, Any]], name: str) -> PythonInImage:
    """Of what the Pythons of an image say about themselves, the one that nodes would run in.

    Raises:
        EnvironmentFault: if there is none that could ever run nodes.
    """
    if not answers:
        raise EnvironmentFault(
            f"image '{name}' has no Python: take one with Python"
            f" {_dotted(OLDEST)} to {_dotted(NEWEST)}, as python:3.12-slim"
        )
    answer = next((each for each in answers if each["has_rclpy"]), answers[0])
    major, minor = answer["version"]
    found = PythonInImage(answer["python"], (major, minor), answer["has_rclpy"], answer["setup"])
    if not found.has_rclpy:
        _refuse(found, answer, name)
    return found


def _refuse(found: PythonInImage, answer: Mapping[str, Any], name: str) -> None:
    """There are no wheels of rclpy for everything."""
    version = found.version
    if not answer["glibc"]:
        why, remedy = "another C library than glibc", "Debian or Ubuntu, as python:3.12-slim"
    elif answer["machine"] != "x86_64":
        why, remedy = f"a processor of the kind {answer['machine']}", "x86_64"
    elif not OLDEST <= version <= NEWEST:
        why, remedy = f"Python {_dotted(version)}", f"Python {_dotted(OLDEST)} to {_dotted(NEWEST)}"
    else:
        return
    raise EnvironmentFault(
        f"image '{name}' has {why}, for which there is no package of rclpy: take an image with"
        f" {remedy}, or one with a ROS distribution"
    )


def _output(engine: DockerClient, image: str, name: str) -> str:
    """Output of the probe, in a container that is removed afterwards."""
    try:
        container = engine.containers.create(
            image,
            entrypoint=["/bin/sh", "-c", _PROBE],
            command=[],
            environment={"PROOF": _PROOF, "FACTS": _FACTS, "ROS_LOG_DIR": "/tmp", "HOME": "/tmp"},
            labels={"neuros.probe": "1"},
            network_mode="none",
            user="65534:65534",
            cap_drop=["ALL"],
            security_opt=["no-new-privileges"],
        )
    except NotFound:
        raise EnvironmentFault(f"there is no image '{name}'") from None
    try:
        container.start()
        container.wait(timeout=_TIMEOUT_S)
        return str(container.logs(stdout=True, stderr=False).decode(errors="replace"))
    except APIError as error:
        if "no such file" in str(error).lower():  # it has no shell, so it has no Python to speak of
            return ""
        raise
    finally:
        container.remove(force=True, v=True)


def _facts(output: str) -> list[dict[str, Any]]:
    found = []
    for line in output.splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:  # what a ROS distribution prints while it is sourced
            continue
    return [each for each in found if isinstance(each, dict)]


def _dotted(version: tuple[int, int]) -> str:
    return ".".join(map(str, version))
