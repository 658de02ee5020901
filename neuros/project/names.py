"""Names on the ROS graph: the namespace of a project, and its remapping rules.

As in ROS 2 (design.ros2.org, "Topic and Service name mapping to DDS" and "Remapping Names"): a
relative name begins in the namespace, ``~`` stands for the node, an absolute name is left alone.
A rule replaces a name if their full names are equal; the first rule that fits counts, once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MOST_CHARACTERS = 247
"""Of a topic's full name: DDS allows 255, and ROS adds up to 8 (``rmw/validate_full...``)."""

INTERNAL = "/neuros/"
"""The prefix of the topics of connections, within the namespace."""

SESSION = "/neuros/session/"
"""The prefix of external topics that a session feeds; the ROS graph does not show them."""


@dataclass(frozen=True)
class Names:
    """The names of a project on the ROS graph.

    Attributes:
        namespace: empty, or as in ``/left`` or ``/lab/left``.
        remap: rules ``(from, to)``; ``node:from`` holds for one node alone.
    """

    namespace: str = ""
    remap: tuple[tuple[str, str], ...] = ()

    def full(self, name: str, node: str) -> str:
        """The full name of ``name`` on a node, before rules."""
        if name.startswith("/"):
            return name
        if name.startswith("~/"):
            return f"{self.namespace}/{node}{name[1:]}"
        return f"{self.namespace}/{name}"

    def resolve(self, name: str, node: str) -> str:
        """The full name of ``name`` on a node, after rules."""
        full = self.full(name, node)
        for rule, new in self.remap:
            only, _, old = rule.rpartition(":")
            if only in ("", node) and self.full(old, node) == full:
                return self.full(new, node)
        return full

    @property
    def ros_arguments(self) -> list[str]:
        """The rules as arguments of ROS's command line."""
        rules = [part for old, new in self.remap for part in ("-r", f"{old}:={new}")]
        return ["--ros-args", *rules] if rules else []


def names_from(namespace: str, remap: Mapping[str, str]) -> Names:
    """The names of a project, from valid values of its keys."""
    return Names(f"/{namespace.strip('/')}".rstrip("/"), tuple(remap.items()))


def names_to_json(names: Names) -> dict[str, Any]:
    """Names as JSON, without empty ones."""
    content: dict[str, Any] = {"namespace": names.namespace, "remap": dict(names.remap)}
    return {key: value for key, value in content.items() if value}
