"""Ports of arrays in a program's hand: sessions and the plugin harness."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import neuros
from neuros.api.session import Session
from neuros.errors import HookError, UsageError
from neuros.testing import PluginHarness, wire

CART = """
import numpy as np
from neuros.hooks import Optional, neuros_function, neuros_initialise

@neuros_initialise()
def begin(node):
    node.set_user_data(np.zeros(2))

@neuros_function(inputs=Optional("force"), outputs=["state", Optional("far")])
def step(node, force):
    state = node.get_user_data()
    if force is not None:
        state[1] += 0.5 * force[0]
    state[0] += state[1]
    far = node.make_packet("far")
    far[:] = state > 1
    return state, far if far.any() else None
"""
PORTS: dict[str, Any] = {
    "inputs": {"force": "float64[1]"},
    "outputs": {"state": "float64[2]", "far": "bool[2]"},
}


@pytest.fixture(params=["local", "in-process", "process"])
def session(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Session]:
    (tmp_path / "cart.py").write_text(CART)
    ports = {
        side: [{"name": name, "type": kind} for name, kind in types.items()]
        for side, types in PORTS.items()
    }
    node = {"name": "cart", "container": "neuros_python", "plugin": "cart.py", **ports}
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}))
    project = neuros.Project.from_file(tmp_path)
    with project.session(backend=request.param, output=tmp_path / "run") as session:
        yield session


def test_a_session_sends_and_reads_arrays(session: Session) -> None:
    force = np.array([1.0])
    states, probe = [], session.probe("cart.state")
    for _ in range(3):
        session.send("cart.force", force)
        force += 1.0  # it was sent as it was
        session.step()
        states.append(session["cart.state"].packet)
    assert np.array_equal(states, [[0.5, 0.5], [2.0, 1.5], [5.0, 3.0]])
    assert np.array_equal(probe.array(), states)
    assert np.array_equal(session["cart.state"].packets, states)
    with pytest.raises(UsageError, match=r"cart.state: float64\[2\] has no field 'data'"):
        probe.array("data")
    assert session["cart.far"].packet.tolist() == [True, True]
    assert (session["cart.state"].count, session["cart.far"].count) == (3, 2)
    with pytest.raises(ValueError, match="read-only"):
        states[-1][0] = 7.0
    session.reset()
    session.step()
    assert session["cart.state"].packet.tolist() == [0.0, 0.0]
    assert session["cart.far"].packet is None


@pytest.mark.parametrize(
    ("wrong", "error", "text"),
    [
        (
            1.0,
            TypeError,
            r"input 'force' takes float64\[1\], not 1.0: make an array of it, numpy.as",
        ),
        ([1.0], TypeError, r"takes float64\[1\], not \[1.0\]: make an array of it"),
        (np.ones(1, "float32"), ValueError, r"float32\[1\]: convert it, array.astype\('float64'\)"),
        (np.ones((1, 1)), ValueError, r"float64\[1,1\]: reshape it, array.reshape\(1\)"),
        (np.float64(1.0), TypeError, r"takes float64\[1\]"),
    ],
)
def test_a_session_refuses_anything_else(
    session: Session, wrong: Any, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        session.send("cart.force", wrong)
    session.step()
    assert session["cart.state"].packet.tolist() == [0.0, 0.0]


# ---------------------------------------------------------------------- the plugin harness


SUM = """
from neuros.hooks import All, neuros_function

@neuros_function(inputs=["force", All("wind")], outputs="sum")
def add(node, force, wind):
    force = force + sum(wind)
    return force
"""


def harness(tmp_path: Path, text: str, inputs: Any, outputs: Any, **more: Any) -> PluginHarness:
    (tmp_path / "plugin.py").write_text(text)
    return PluginHarness(tmp_path / "plugin.py", inputs=inputs, outputs=outputs, **more)


def test_the_harness_sends_and_receives_arrays(tmp_path: Path) -> None:
    gusts = [wire(f"{name}.wind -> node.wind", 0) for name in ("north", "south")]
    inputs, outputs = {"force": "float64[2]", "wind": "float64[2]"}, {"sum": "float64[2]"}
    with harness(tmp_path, SUM, inputs, outputs, connections=gusts) as node:
        node.block("sum")
        force = node.make_packet("force")
        for value in (1.0, 2.0):
            force[:] = value
            node.send("force", force)
            node.send("wind", np.array([10.0, 20.0]), source="north")
            node.send("wind", np.array([100.0, 200.0]), source="south")
        assert node.run() == 1
        node.acknowledge("sum")
        assert node.run() == 1
        assert np.array_equal(node.received("sum"), [[111.0, 221.0], [112.0, 222.0]])


ONE = """
import numpy as np
from neuros.hooks import neuros_function

@neuros_function(inputs="heard", outputs="said")
def answer(node, heard):
    return {answer}
"""
HEARD_AND_SAID = {"heard": "float64[3]"}, {"said": "float64[3]"}


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (
            "heard.tolist()",
            r"returned list for output 'said', which carries float64\[3\]: use"
            r" node.make_packet\(\"said\"\), or numpy.asarray\(values, 'float64'\)",
        ),
        ("[heard.tolist()]", r"returned list for output 'said'"),
        ("(1.0, 2.0, 3.0)", r"returned tuple for output 'said', which carries float64\[3\]"),
        ("heard.sum()", r"returned numpy.float64 for output 'said'"),
        (
            "heard.astype('float32')",
            r"packet for output 'said': the array must be float64\[3\], but is float32\[3\]:"
            r" convert it, array.astype\('float64'\)",
        ),
        ("heard > 0", r"but is bool\[3\]: convert it"),
        ("heard[:2]", r"must be float64\[3\], but is float64\[2\]"),
        ("heard[None]", r"but is float64\[1,3\]: reshape it, array.reshape\(3\)"),
        ("heard.__setitem__(0, 1.0)", "assignment destination is read-only"),
        ("None", "returned no packet for output 'said'"),
    ],
)
def test_a_hook_that_returns_anything_else_fails_with_what_to_do(
    tmp_path: Path, answer: str, text: str
) -> None:
    with harness(tmp_path, ONE.format(answer=answer), *HEARD_AND_SAID) as node:
        node.send("heard", np.ones(3))
        with pytest.raises(HookError, match=text):
            node.run()


def test_what_a_hook_received_may_be_sent_on(tmp_path: Path) -> None:
    with harness(tmp_path, ONE.format(answer="heard"), *HEARD_AND_SAID) as node:
        packets = [np.full(3, value) for value in (1.0, np.nan, np.inf)]
        node.send("heard", *packets)
        node.run()
        assert np.array_equal(node.received("said"), packets, equal_nan=True)


@pytest.mark.parametrize("written", ["float64[]", "float16[3]", "float64", "float64[n]"])
def test_the_harness_refuses_what_is_no_type(tmp_path: Path, written: str) -> None:
    with pytest.raises(ValueError, match=rf"'heard': '{re.escape(written)}'"):
        harness(tmp_path, SUM, {"heard": written}, {})
