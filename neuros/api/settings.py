"""Values in the place of those in a project's files, as Python programs give them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from neuros.errors import UsageError
from neuros.project.model import Project

_ENVIRONMENT = "environment"


def override_texts(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """As the texts of ``--set``: ``{"nodes.a.environment.RATE": 0.5}``. ``None`` removes a key."""
    return tuple(f"{path}={value_text(path, value)}" for path, value in settings.items())


def value_text(path: str, value: Any) -> str:
    """A value as ``--set`` has it; in ``environment`` all is text.

    Raises:
        UsageError: if it is nothing that JSON knows.
    """
    if value is None:
        return ""
    if isinstance(value, str) and path.split(".")[2:3] == [_ENVIRONMENT]:
        return value
    try:
        return json.dumps(value.tolist() if hasattr(value, "tolist") else value)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{path}: {error}") from error


def seed_texts(project: Project, seed: int) -> tuple[str, ...]:
    """Overrides that give this seed to every node that has one.

    A seed is a variable in the ``environment`` of a node whose name contains SEED.

    Raises:
        UsageError: if no node has one.
    """
    places = [
        f"nodes.{node.name}.{_ENVIRONMENT}.{name}"
        for node in project.nodes
        for name in node.environment
        if "SEED" in name.upper()
    ]
    if not places:
        raise UsageError(
            f"seed {seed}: no node of {project.name} has a variable with SEED in its name in its"
            " environment: add one there, or set what its plugin takes for a seed"
        )
    return tuple(f"{place}={int(seed)}" for place in places)
