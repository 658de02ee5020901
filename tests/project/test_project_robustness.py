"""Whatever the files say: a project or its problems, never a crash."""

from __future__ import annotations

import copy
import json
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.errors import ProjectError
from neuros.project.load import load_project

STRING = "std_msgs/msg/String"
PROJECT: dict[str, Any] = {
    "nodes": [
        {
            "name": "a", "container": "neuros_python", "plugin": "p.py", "script": "p.py",
            "environment": {"A": "1", "B": "#p.py"},
            "outputs": [{"name": "x", "type": STRING, "mujoco": {"sensor": "clock", "rate": 1}}],
        },
        {
            "name": "b", "container": "neuros_nest", "plugin": "p.py",
            "inputs": [{"name": "x", "type": STRING, "mujoco": {"actuator": "m"}},
                       {"name": "y", "type": STRING, "external_topic": "/y"}],
        },
    ],
    "connections": [
        {"source_node": "a", "source_output": "x", "destination_node": "b",
         "destination_input": "x", "discard_limit": 0, "queue_size": 2},
    ],
}  # fmt: skip
WORDS = ["a", "x", "p.py", "project.json", "#", "@", "", "\0", "\ud800", "a/" * 3000, STRING]
VALUES: Any = st.recursive(
    st.sampled_from([*WORDS, None, True, -1, 0, 1e400, 0.5]),
    lambda inner: (
        st.lists(inner, max_size=2)
        | st.dictionaries(st.sampled_from(["name", "type", "plugin", "", "zzz"]), inner, max_size=2)
    ),
    max_leaves=4,
)
STEPS = ["nodes", "connections", "a", "b", "x", "inputs", "outputs", "environment", "mujoco", "0",
         "name", "discard_limit", ""]  # fmt: skip


def places(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    if not isinstance(value, dict | list):
        return [path]
    children = value.items() if isinstance(value, dict) else enumerate(value)
    return [path, *(p for key, child in children for p in places(child, (*path, key)))]


def replaced(path: tuple[str | int, ...], by: Any) -> Any:
    if not path:
        return by
    result = copy.deepcopy(PROJECT)
    parent: Any = result
    for step in path[:-1]:
        parent = parent[step]
    parent[path[-1]] = by
    return result


def outcome(content: Any, *overrides: str) -> object:
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "p.py").touch()
        file = Path(name) / "project.json"
        file.write_text(json.dumps(content).replace("Infinity", "1e400"))
        try:
            return load_project(file, workspace=Path(name), overrides=overrides)
        except ProjectError as error:
            return error


def test_the_project_itself_is_valid() -> None:
    assert not isinstance(outcome(PROJECT), ProjectError)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(places(PROJECT)), VALUES)
def test_any_value_may_stand_anywhere(path: tuple[str | int, ...], value: Any) -> None:
    outcome(replaced(path, value))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.lists(st.sampled_from(STEPS), max_size=7), max_size=3), VALUES)
def test_any_override_may_be_given(targets: list[list[str]], value: Any) -> None:
    outcome(PROJECT, *(".".join(steps) + "=" + json.dumps(value) for steps in targets))
    outcome(PROJECT, *(".".join(steps) + "=" for steps in targets))
