"""``"budgets"``: what must hold of every run of a project."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from neuros.errors import Problem
from neuros.project.draft import Draft
from neuros.project.model import Budgets
from neuros.project.source import Element
from neuros.project.suggest import did_you_mean

_ENDS = ("source_node", "source_output", "destination_node", "destination_input")


def budgets_of(draft: Draft) -> Budgets:
    """The budgets of a valid project."""
    element = draft.root.member("budgets")
    values: dict[str, Any] = {} if element is None else element.plain
    return Budgets(
        lost_packets={name: int(most) for name, most in values.get("lost_packets", {}).items()},
        real_time_factor=values.get("real_time_factor"),
        tick_error_ms=values.get("tick_error_ms"),
    )


def budgets_to_json(budgets: Budgets) -> dict[str, Any]:
    """As a project file has them; only those that there are."""
    content = {
        "lost_packets": dict(budgets.lost_packets),
        "real_time_factor": budgets.real_time_factor,
        "tick_error_ms": budgets.tick_error_ms,
    }
    return {key: value for key, value in content.items() if value not in (None, {})}


def budget_mistakes(draft: Draft) -> Iterator[Problem]:
    """Budgets for connections that the project has not."""
    budgets = draft.root.member("budgets")
    limits = None if budgets is None else budgets.member("lost_packets")
    if limits is None or not isinstance(limits.value, dict):
        return
    names = [_name(connection) for connection in draft.connections]
    known = [name for name in names if name is not None]
    for name, member in limits.value.items():
        if name not in known and len(known) == len(names):
            hint = did_you_mean(name, known) or "write 'a.out -> b.in', as `neuros launch` does"
            yield member.key_problem(f"there is no connection '{name}'", hint)


def _name(connection: Element) -> str | None:
    """``a.out -> b.in``, ``None`` if an end is missing."""
    source, output, destination, input_ = (connection.string(end) for end in _ENDS)
    if None in (source, output, destination, input_):
        return None
    return f"{source}.{output} -> {destination}.{input_}"
