"""``"parameters"``: values for the ROS parameters of a node's ROS node."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from neuros.errors import Problem
from neuros.project.model import Value
from neuros.project.parsed import ParsedProject
from neuros.project.scanner import Element

_INT64 = 1 << 63
# ROS declares these itself, and passes over what is neither true nor false.
_TRUTH_VALUES = ("use_sim_time", "start_type_description_service")


def parameters_of(written: Mapping[str, Any]) -> dict[str, Value]:
    """Values by full name (``gain.p``), from valid ones that may lie in each other.

    Numbers of one list are of one kind: with a float among them, all are.
    """
    found: dict[str, Value] = {}
    for name, value in written.items():
        if isinstance(value, Mapping):
            inner = parameters_of(value)
            found |= {f"{name}.{part}": each for part, each in inner.items()}
        elif isinstance(value, list | tuple):
            has_floats = any(isinstance(item, float) for item in value)
            found[name] = tuple(map(float, value)) if has_floats else tuple(value)
        else:
            found[name] = value
    return found


def parameters_to_json(parameters: Mapping[str, Value]) -> dict[str, Any]:
    """As a project file has them."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in parameters.items()
    }


def parameter_mistakes(parsed: ParsedProject) -> Iterator[Problem]:
    """What ROS has no type for, and names that occur twice."""
    for node in parsed.nodes:
        parameters = node.member("parameters")
        if parameters is not None and isinstance(parameters.value, dict):
            yield from _mistakes(parameters, "", {})


def _mistakes(group: Element, prefix: str, seen: dict[str, Element]) -> Iterator[Problem]:
    for name, member in group.value.items():
        full = prefix + name
        if isinstance(member.value, dict):
            yield from _mistakes(member, f"{full}.", seen)
            continue
        if seen.setdefault(full, member) is not member:
            yield member.key_problem(f"the parameter '{full}' occurs twice")
        if full in _TRUTH_VALUES and not isinstance(member.value, bool):
            yield member.problem("must be true or false, as ROS declares it")
        values = member.value if isinstance(member.value, list) else [member]
        kinds = {_kind(each.value) for each in values}
        if len(kinds) > 1:
            yield member.problem(
                f"the list has {' and '.join(sorted(kinds))}", "ROS has lists of one kind only"
            )
        for each in values:
            if type(each.value) is int and not -_INT64 <= each.value < _INT64:
                yield each.problem("is too large for an integer of ROS, which has 64 bits")


def _kind(value: object) -> str:
    """What ROS tells apart."""
    if isinstance(value, bool):
        return "truth values"
    if isinstance(value, int | float):
        return "numbers"
    return "texts" if isinstance(value, str) else "other values"
