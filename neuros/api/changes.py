"""Settings that change a run while it goes on, as a fork does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from neuros.api.loading import with_model_fields
from neuros.errors import UsageError
from neuros.ports import Changes
from neuros.project.model import Project
from neuros.project.suggest import did_you_mean

_KINDS = (["environment"], ["parameters"])
CHANGES_IN_WORDS = (
    "a fork changes nodes.NODE.environment.VARIABLE, nodes.NODE.parameters.NAME and"
    " NODE.model.FIELD, each to a value"
)


def changes_of(
    project: Project,
    settings: Mapping[str, Any],
    load: Callable[[Mapping[str, Any]], Project],
) -> Changes:
    """What nodes are told at the moment of a fork.

    Args:
        project: as the run began.
        settings: by path.
        load: checks the project with settings, and returns it.

    Raises:
        UsageError: with all paths that a fork cannot change; for a parameter that is new.
        ProjectError: as ``load``.
    """
    settings = with_model_fields(project, settings)
    parts = {path: path.split(".") for path, value in settings.items() if value is not None}
    possible = {
        path
        for path, (kind, *rest) in parts.items()
        if kind == "nodes" and len(rest) > 2 and rest[1:2] in _KINDS
    }
    wrong = [path for path in settings if path not in possible]
    if wrong:
        raise UsageError(f"set: {', '.join(wrong)}: {CHANGES_IN_WORDS}")
    if not settings:
        return {}
    changed, found = load(settings), {}
    for before, after in zip(project.nodes, changed.nodes, strict=True):
        variables = _differing(before.environment, after.environment)
        parameters = _differing(before.parameters, after.parameters)
        for name in parameters.keys() - before.parameters.keys():
            known = ", ".join(before.parameters) or "none"
            hint = did_you_mean(name, before.parameters) or f"it has {known}"
            raise UsageError(f"set: node '{before.name}' has no parameter '{name}' ({hint})")
        if variables or parameters:
            found[before.name] = variables, parameters
    return found


def _differing(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in after.items() if before.get(name) != value}
