"""Nodes with copies: one hook for many worlds, with an axis of copies on all arrays."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import neuros
from neuros.errors import HookError, ProjectError
from neuros.hooks import (
    Optional,
    hook_specs_of,
    neuros_function,
    neuros_initialise,
    neuros_reset,
    neuros_tick,
)
from neuros.testing import PluginHarness

CARTS = """
import numpy as np
from neuros.hooks import Optional, neuros_function, neuros_initialise

@neuros_initialise(outputs="state", batch=True)
def begin(node):
    starts = [np.random.default_rng(seed).uniform(-1, 1, 2) for seed in node.seeds]
    node.set_user_data(np.array(starts))
    return node.get_user_data()

@neuros_function(inputs=[Optional("force"), Optional("reset")], outputs="state", batch=True)
def step(node, force, reset):
    state = node.get_user_data()
    if reset is not None:
        state[reset] = 0
    state[:, 1] += 0 if force is None else force[:, 0]
    state[:, 0] += state[:, 1]
    return state
"""
CART = {
    "name": "carts",
    "container": "neuros_python",
    "plugin": "carts.py",
    "copies": 3,
    "inputs": [{"name": "force", "type": "float64[1]"}, {"name": "reset", "type": "bool[1]"}],
    "outputs": [{"name": "state", "type": "float64[2]"}],
    "environment": {"SEED": "1"},
}


def carts(folder: Path, text: str = CARTS, **keys: Any) -> neuros.Project:
    (folder / "carts.py").write_text(text.replace("state[reset]", "state[reset[:, 0]]"))
    (folder / "project.json").write_text(json.dumps({"nodes": [{**CART, **keys}]}))
    return neuros.Project.from_file(folder)


def steps(project: neuros.Project, folder: Path, count: int = 4, **options: Any) -> Any:
    """The states of some steps, each copy pushed by another force, of which one is reset."""
    copies = 0
    with project.session(output=folder / "run", **options) as session:
        copies = session["carts.state"].packet.shape[0]
        found = [session["carts.state"].packet]
        for number in range(count):
            if number == 2:
                session.send("carts.reset", (np.arange(copies) == 1)[:, None])
            session.send("carts.force", np.arange(copies, dtype=float)[:, None])
            session.step()
            found.append(session["carts.state"].packet)
    return np.array(found)


@pytest.mark.parametrize("backend", ["local", "in-process", "process"])
def test_a_hook_serves_all_copies_at_once(tmp_path: Path, backend: str) -> None:
    found = steps(carts(tmp_path), tmp_path, backend=backend)
    start = found[0]
    assert found.shape == (5, 3, 2)
    assert len({*start.ravel()}) == 6  # each copy has a generator of its own
    for copy in range(3):
        state = start[copy].copy()
        for number, seen in enumerate(found[1:]):
            if number == 2 and copy == 1:
                state[:] = 0
            state[1] += copy
            state[0] += state[1]
            assert np.array_equal(seen[copy], state)


def test_a_copy_is_the_same_among_any_number(tmp_path: Path) -> None:
    project = carts(tmp_path)
    many = steps(project.with_settings({"nodes.carts.copies": 5}), tmp_path / "many")
    assert many.shape == (5, 5, 2)
    assert np.array_equal(steps(project, tmp_path / "few"), many[:, :3])


def test_a_recording_has_an_axis_of_copies(tmp_path: Path) -> None:
    steps(carts(tmp_path), tmp_path, backend="process", record=True)
    with neuros.Run(tmp_path / "run").bag as bag:
        forces = bag["/neuros/session/carts/force"].array()["data"]
    assert np.array_equal(forces, [np.arange(3.0)[:, None]] * 4)


def test_the_expanded_project_is_a_project_with_copies(tmp_path: Path) -> None:
    project = carts(tmp_path)
    expanded = json.loads(project.text())
    assert expanded["nodes"][0]["copies"] == 3
    assert expanded["nodes"][0]["outputs"] == CART["outputs"]
    assert "  out state  float64[3,2]" in project.graph()


def test_a_project_in_python_has_copies(tmp_path: Path) -> None:
    @neuros_function(inputs=Optional("x"), outputs="y", batch=True)
    def double(node: neuros.NodeHandle, x: Any) -> Any:
        return np.ones((node.copies, 2)) if x is None else 2 * x

    ports: dict[str, Any] = {"inputs": {"x": "float64[2]"}, "outputs": {"y": "float64[2]"}}
    one = neuros.Node("one", double, copies=4, **ports)
    other = neuros.Node("other", double, copies=4, **ports)
    project = neuros.Project([one, other], [neuros.Connection(one["y"], other["x"])])
    with project.session(output=tmp_path / "run") as session:
        session.step(3)
        assert session["other.y"].packet.shape == (4, 2)


# ---------------------------------------------------------------------- mistakes


NO_BATCHES = (
    "hook 'begin': node 'carts' has 3 copies, but the hook takes no batches"
    " (write batch=True in its decorator: its arrays have a leading axis)"
)
NO_COPIES = (
    "hook 'begin': takes batches, but node 'carts' has no \"copies\""
    ' (give it "copies": 1, or more)'
)


@pytest.mark.parametrize(
    ("text", "keys", "mistake"),
    [
        (CARTS.replace(", batch=True", ""), {}, f"carts.py:5:2: {NO_BATCHES}"),
        (CARTS, {"copies": None}, f"carts.py:5:2: {NO_COPIES}"),
        (
            CARTS.replace("batch=True", "batch=3", 1),
            {},
            "carts.py:5:43: hook 'begin': batch=3: write batch=True, or leave it out",
        ),
    ],
)
def test_hooks_and_copies_that_do_not_fit_are_refused(
    tmp_path: Path, text: str, keys: Any, mistake: str
) -> None:
    node = {key: value for key, value in {**CART, **keys}.items() if value is not None}
    (tmp_path / "carts.py").write_text(text)
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}))
    with pytest.raises(ProjectError) as caught:
        neuros.Project.from_file(tmp_path)
    assert mistake in str(caught.value)


@pytest.mark.parametrize(
    ("text", "copies", "mistake"),
    [(CARTS.replace(", batch=True", ""), 3, NO_BATCHES), (CARTS, None, NO_COPIES)],
)
def test_hooks_whose_declaration_is_computed_are_refused_when_they_are_loaded(
    tmp_path: Path, text: str, copies: int | None, mistake: str
) -> None:
    (tmp_path / "carts.py").write_text(text)
    with pytest.raises(HookError) as caught:
        harness_of(tmp_path, copies)
    expected, hint = mistake.replace("'carts'", "'node'").rstrip(")").split(" (")
    assert f"carts.py:5: {expected}: {hint}" in str(caught.value)


def test_a_hook_without_ports_needs_no_word_about_batches(tmp_path: Path) -> None:
    text = CARTS.replace('outputs="state", batch=True', "", 1)
    text = text.replace("    return node.get_user_data()\n", "", 1)
    assert carts(tmp_path, text).nodes == ("carts",)


@pytest.mark.parametrize(
    "mark",
    [neuros_function, neuros_initialise, neuros_reset, neuros_tick],
    ids=lambda f: f.__name__,
)
def test_each_decorator_takes_a_truth_value(mark: Callable[..., Any]) -> None:
    period = {"seconds": 0.1} if mark is neuros_tick else {}

    def hook(node: object) -> None: ...

    assert [spec.is_batch for spec in hook_specs_of({"": mark(**period, batch=True)(hook)})] == [
        True
    ]
    with pytest.raises(HookError, match="batch='yes': write batch=True, or leave it out"):
        mark(**period, batch="yes")(hook)


def test_a_packet_without_the_axis_is_refused(tmp_path: Path) -> None:
    text = CARTS.replace("return state", "return state[0]")
    (tmp_path / "carts.py").write_text(text)
    harness = harness_of(tmp_path)
    harness.send("force", np.zeros((3, 1)))
    with pytest.raises(HookError, match=r"must be float64\[3,2\], but is float64\[2\]"):
        harness.run()


# ---------------------------------------------------------------------- seeds


def harness_of(folder: Path, copies: int | None = 3, environment: Any = None) -> PluginHarness:
    return PluginHarness(
        folder / "carts.py",
        inputs={"force": "float64[1]", "reset": "bool[1]"},
        outputs={"state": "float64[2]"},
        environment={"SEED": "1"} if environment is None else environment,
        copies=copies,
    )


@given(seed=st.integers(0, 2**64), copies=st.integers(1, 20), more=st.integers(0, 5))
def test_seeds_are_those_of_numpy(seed: int, copies: int, more: int) -> None:
    @neuros_initialise()
    def begin(node: neuros.NodeHandle) -> None:
        node.set_user_data(node.seeds)

    def seeds(copies: int) -> list[int]:
        with PluginHarness(begin, environment={"SEED": str(seed)}, copies=copies) as harness:
            harness.run()
            found: list[int] = harness.node.get_user_data()
        return found

    children = np.random.SeedSequence(seed).spawn(copies)
    assert seeds(copies) == [int(each.generate_state(1, np.uint64)[0]) for each in children]
    assert seeds(copies + more)[:copies] == seeds(copies)


@pytest.mark.parametrize(
    ("environment", "text"),
    [
        ({}, "needs one variable with SEED in its name in its environment, and has none"),
        ({"SEED": "1", "SEED_OF_NOISE": "2"}, "and has several: SEED, SEED_OF_NOISE"),
        ({"SEED": "-1"}, "SEED='-1' is no whole number from 0 on"),
        ({"SEED": "one"}, "SEED='one' is no whole number"),
    ],
)
def test_seeds_need_one_variable(tmp_path: Path, environment: Any, text: str) -> None:
    (tmp_path / "carts.py").write_text(CARTS)
    with pytest.raises(HookError, match=text):
        harness_of(tmp_path, environment=environment).run()


def test_a_reset_gives_other_seeds(tmp_path: Path) -> None:
    with carts(tmp_path).session(output=tmp_path / "run") as session:
        first = session["carts.state"].packet
        session.reset(seed=2)
        second = session["carts.state"].packet
        session.reset(seed=1)
        assert np.array_equal(session["carts.state"].packet, first)
        assert not np.array_equal(second, first)


# ---------------------------------------------------------------------- the page


def test_the_carts_of_the_page_move(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "plugins.md").read_text("utf-8")
    section = page.partition("### Many worlds\n")[2]
    node, plugin = re.findall(r"```(?:json|python)\n(.*?)```", section, re.DOTALL)[:2]
    (tmp_path / "carts.json").write_text(node)
    (tmp_path / "carts.py").write_text(plugin)
    with PluginHarness.from_node_file(tmp_path / "carts.json") as harness:
        for _ in range(2):
            harness.send("force", np.ones((64, 1)))
            harness.run()
        first, second = harness.received("state")
    assert first.shape == (64, 2)
    assert np.allclose(second - first, np.stack([0.01 * second[:, 1], np.full(64, 0.01)], axis=1))
