"""``PluginHarness`` converts and refuses values as the back ends do, in what goes in and out."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from message_values import is_empty, message_classes, parts, right_messages, wrong_messages
from std_msgs.msg import Float64, UInt8

from neuros.errors import HookError
from neuros.testing import PluginHarness, wire

PLUGIN = """
from neuros.hooks import neuros_function

@neuros_function(inputs="sent", outputs=["first", "second", "own"])
def pass_on(node, sent):
    given = node.get_user_data()
    return given[0], given[1], given[1]

@neuros_function(inputs="back")
def take(node, back):
    node.taken.append(back)
"""
KINDS = message_classes()
OFTEN = settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("plugin") / "plugin.py"
    file.write_text(PLUGIN.replace("node.taken", "node.get_user_data()[2]"))
    return file


def harness_for(plugin: Path, kind: Any, run_folder: Path) -> PluginHarness:
    """A node that returns what it is given, for two others and for itself."""
    name = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
    return PluginHarness(
        plugin,
        inputs={"sent": name, "back": name},
        outputs={"first": name, "second": name, "own": name},
        connections=[wire("node.own -> node.back", discard_limit=0)],
        run_folder=run_folder,
    )


@OFTEN
@given(st.sampled_from(KINDS).flatmap(lambda kind: st.tuples(*[right_messages(kind)] * 3)))
def test_what_fits_arrives_as_its_definition_says(plugin: Path, messages: Any) -> None:
    (first, seen_first), (second, seen_second), (sent, seen_sent) = messages
    with harness_for(plugin, type(first), plugin.parent) as harness:
        taken: list[Any] = []
        harness.node.set_user_data((first, second, taken))
        harness.send("sent", sent)
        harness.run()
        assert parts(sent) == parts(seen_sent)
        assert parts(harness.received("first")[0]) == parts(seen_first)
        assert parts(harness.received("second")[0]) == parts(seen_second)
        assert parts(taken[0]) == parts(seen_second)


@OFTEN
@given(
    st.sampled_from([kind for kind in KINDS if not is_empty(kind)]).flatmap(wrong_messages),
    st.booleans(),
)
def test_what_does_not_fit_is_refused_and_nothing_is_sent(
    plugin: Path, wrong: Any, is_first: bool
) -> None:
    kind = type(wrong.message)
    with harness_for(plugin, kind, plugin.parent) as harness:
        given = (wrong.message, kind()) if is_first else (kind(), wrong.message)
        harness.node.set_user_data((*given, []))
        harness.send("sent", kind())
        with pytest.raises(HookError) as caught:
            harness.run()
        output = "first" if is_first else "second"
        what = f"packet for output '{output}': field '{wrong.path}' must be "
        assert re.match(rf".*plugin\.py:\d+: hook 'pass_on': {re.escape(what)}", str(caught.value))
        assert not harness.received("first")
        assert not harness.received("second")
        assert {each["sent"] for each in harness.connections.values() if "sent" in each} == {0}


def test_a_test_cannot_send_what_no_node_may_send(plugin: Path, tmp_path: Path) -> None:
    harness = harness_for(plugin, UInt8, tmp_path)
    text = "packet for input 'sent': field 'data' must be uint8: 0 to 255, but is 300 (int)"
    with pytest.raises(ValueError, match=re.escape(text)):
        harness.send("sent", UInt8(data=1), UInt8(data=300))
    assert harness.unsent("sent") == 0
    assert harness.run() == 0


def test_the_values_that_were_seen_are_right(plugin: Path, tmp_path: Path) -> None:
    for number in (1, numpy.float32(1), numpy.bool_(True)):
        harness = harness_for(plugin, Float64, tmp_path)
        harness.node.set_user_data((Float64(data=number), Float64(), []))
        harness.send("sent", Float64())
        harness.run()
        assert harness.received("first") == [Float64(data=1.0)]
