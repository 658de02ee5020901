"""Gazebo keys of project files of NeuROS 1.0: read, and named in a warning.

MuJoCo stands in for Gazebo. None of this is a mistake, and none of it may pass unnoticed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from neuros.errors import Problem
from neuros.project.parsed import ParsedProject
from neuros.project.scanner import Element

_STAND_INS: Mapping[str, str] = {"neuros_gazebo": "neuros_mujoco"}
_PREFIXES = ("GZ_", "IGN_", "GAZEBO_")
_RESOURCES = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH")


def container_in_place_of(name: str) -> str:
    """The container that a node runs in; another one only where Gazebo's was asked for."""
    return _STAND_INS.get(name, name)


def is_for_gazebo(variable: str) -> bool:
    """Whether an environment variable is one of Gazebo's, so that its path need not exist."""
    return variable.startswith(_PREFIXES)


def remarks_on_gazebo(parsed: ParsedProject) -> Iterator[Problem]:
    """What has no meaning here, by node: its container, its environment, its ports."""
    for node in parsed.nodes:
        container = node.string("container") or ""
        if container in _STAND_INS:
            yield node.value["container"].problem(
                f"Gazebo is not supported: the node runs in '{_STAND_INS[container]}' instead of"
                f" '{container}'"
            )
        yield from _variables(parsed, node)
        yield from _ports(node)


def _variables(parsed: ParsedProject, node: Element) -> Iterator[Problem]:
    environment = node.member("environment")
    if environment is None or not isinstance(environment.value, dict):
        return
    for name, member in environment.value.items():
        if not is_for_gazebo(name):
            continue
        if name not in _RESOURCES:
            yield member.key_problem(f"'{name}' is for Gazebo and has no effect")
        elif not parsed.roots.finds(member.value, member.source.folder):
            yield member.problem(f"'{name}' is left out: there is no folder '{member.value}'")


def _ports(node: Element) -> Iterator[Problem]:
    ports = [
        port
        for side in ("inputs", "outputs")
        for port in node.items(side)
        if port.member("gazebo_type") is not None
    ]
    if not ports:
        return
    names = ", ".join(f"'{port.string('name')}'" for port in ports)
    has = "port has" if len(ports) == 1 else "ports have"
    bound = any(port.member("external_topic") is not None for port in ports)
    topics = "; their external topics are plain ROS topics, without a bridge" if bound else ""
    yield (
        ports[0]
        .value["gazebo_type"]
        .key_problem(
            f"Gazebo itself is not supported: {len(ports)} {has} a 'gazebo_type', which has no"
            f" effect: {names}{topics}",
            "MuJoCo stands in for it, see the key 'mujoco'",
        )
    )
