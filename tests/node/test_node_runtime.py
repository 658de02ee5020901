"""Plugin services, used through a harness: nothing here needs ROS processes."""

from __future__ import annotations

import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from std_msgs.msg import Int32

from neuros.errors import HookError, ModelError, NodeError, PluginError
from neuros.testing import PluginHarness

INT = "std_msgs/msg/Int32"
DEADLINE_S = 10.0


@pytest.fixture
def plugin(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "plugin.py"
        path.write_text("from neuros.hooks import *\n" + textwrap.dedent(text))
        return path

    return write


ECHO = """
    @neuros_function(inputs="x", outputs="y")
    def echo(node, x):
        return x
"""


def echo(plugin, text: str = "") -> PluginHarness:
    return PluginHarness(plugin(text or ECHO), inputs={"x": INT}, outputs={"y": INT}, name="ann")


# ------------------------------------------------------------------ plugins


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import neuros.gazebo", r"there is no neuros.gazebo: MuJoCo stands in for Gazebo"),
        ("import no_such_module", r"cannot be imported: ModuleNotFoundError.*no_such_module"),
        ("def f(:", r"plugin\.py:2: cannot be imported: SyntaxError"),
        ("raise SystemExit(3)", r"cannot be imported: SystemExit: 3"),
        ("x = 1", r"declares no hooks: mark functions with @neuros_function"),
    ],
)
def test_a_plugin_that_cannot_be_loaded_says_why(plugin, text, message):
    with pytest.raises(PluginError, match=message):
        echo(plugin, text)


def test_a_traceback_begins_in_the_plugin(plugin):
    with pytest.raises(PluginError) as caught:
        echo(plugin, "1 / 0")
    assert 'plugin.py", line 2' in str(caught.value)
    assert "importlib" not in str(caught.value)


def test_a_wrong_port_is_named_with_the_line_of_the_hook(plugin):
    with pytest.raises(HookError, match=r"plugin\.py:3: hook 'f'.*no input 'z' \(it has x\)"):
        echo(plugin, '\n@neuros_function(inputs="z")\ndef f(node, z): ...')


def test_hooks_that_need_no_input_and_inputs_that_no_hook_takes_are_named(plugin):
    text = """
        @neuros_function(outputs="y")
        def step(node):
            return node.make_packet("y")
    """
    records = echo(plugin, text).log
    assert ("INFO", "hook 'step' requires no input: it runs without pause") in records
    assert [severity for severity, _ in records] == ["INFO", "WARN"]
    assert "no hook takes input 'x'" in records[1].text


def test_even_system_exit_in_a_hook_is_an_error_of_the_hook(plugin):
    bench = echo(plugin, '@neuros_function(inputs="x")\ndef f(node, x): raise SystemExit(0)')
    bench.send("x", Int32())
    with pytest.raises(HookError, match="hook 'f': SystemExit: 0"):
        bench.run()


# ------------------------------------------------------------------ the node


def test_a_node_knows_its_name_folder_and_description(plugin):
    node = echo(plugin).node
    assert (node.name, node.run_dir.name) == ("ann", "ann")
    assert node.run_dir.is_dir()
    assert [port.name for port in node.description.inputs] == ["x"]
    assert node.get_user_data() is None
    node.set_user_data({"a": 1})
    assert node.get_user_data() == {"a": 1}
    assert node.get_logger() is node.get_ros_node().get_logger()


def test_packets_are_made_by_output(plugin):
    node = echo(plugin).node
    assert node.make_packet("y") == Int32()
    with pytest.raises(NodeError, match=r"node 'ann' has no output 'x' \(it has y\)"):
        node.make_packet("x")


def test_files_are_found_beside_the_plugin(plugin, tmp_path):
    node = echo(plugin).node
    (tmp_path / "model.xml").touch()
    assert node.resolve_path("model.xml") == tmp_path / "model.xml"
    assert node.resolve_path("#model.xml") == tmp_path / "model.xml"
    with pytest.raises(ModelError, match=r"'nothing.xml' does not exist: looked for /"):
        node.resolve_path("nothing.xml")
    with pytest.raises(ModelError, match="workspace"):
        node.resolve_path("@nothing.xml")
    with pytest.raises(ModelError, match="leaves the project's folder"):
        node.resolve_path("/etc/passwd")


def test_what_is_to_be_closed_is_closed_last_opened_first_after_the_finalise_hooks(plugin):
    text = (
        ECHO
        + """
    @neuros_finalise()
    def end(node):
        node.get_user_data().append("finalise")
"""
    )
    bench = echo(plugin, text)
    order: list[str] = []
    bench.node.set_user_data(order)
    bench.node.on_close(lambda: order.append("first"))
    bench.node.on_close(lambda: order.append("second"))
    bench.finalise()
    assert order == ["finalise", "second", "first"]


def test_a_failing_finalise_hook_does_not_keep_the_others_from_running(plugin):
    text = """
        @neuros_finalise()
        def first(node):
            1 / 0

        @neuros_finalise()
        def second(node):
            node.set_user_data("done")
    """
    bench = echo(plugin, text)
    with pytest.raises(HookError, match="hook 'first': ZeroDivisionError"):
        bench.finalise()
    assert bench.node.get_user_data() == "done"


# ------------------------------------------------------------------ threads of a plugin


def run_until(bench: PluginHarness, condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s
        bench.run()


def submitting(bench: PluginHarness, value: int, cancelled: Callable[[], bool]) -> list[bool]:
    """Submit a packet from a thread; what it returns will be in the list."""
    result: list[bool] = []
    packets = {"y": Int32(data=value)}
    thread = threading.Thread(
        target=lambda: result.append(bench.node.submit(packets, cancelled)), daemon=True
    )
    thread.start()
    return result


def test_a_thread_may_send_as_if_a_hook_had_returned_packets(plugin):
    bench = echo(plugin)
    bench.run()
    result = submitting(bench, 7, lambda: False)
    run_until(bench, lambda: result == [True])
    assert [packet.data for packet in bench.received("y")] == [7]


def test_a_submission_waits_for_a_busy_receiver_and_can_be_withdrawn(plugin):
    bench = echo(plugin)
    bench.block("y")
    bench.send("x", Int32(data=1))
    bench.run()
    wanted = threading.Event()
    result = submitting(bench, 2, wanted.is_set)
    for _ in range(3):
        bench.run()
    assert result == []
    wanted.set()
    run_until(bench, lambda: result == [False])
    bench.unblock("y")
    bench.run()
    assert [packet.data for packet in bench.received("y")] == [1]


def test_a_submission_ends_with_the_node(plugin):
    bench = echo(plugin)
    bench.block("y")
    bench.send("x", Int32(data=1))
    bench.run()
    result = submitting(bench, 2, lambda: False)
    bench.finalise()
    run_until(bench, lambda: result == [False])


def test_a_thread_may_fail_the_node(plugin):
    bench = echo(plugin)
    bench.run()
    bench.node.fail(ValueError("the physics exploded"))
    with pytest.raises(NodeError, match="ValueError: the physics exploded"):
        bench.run()


# ------------------------------------------------------------------ simulated time


def test_a_published_clock_is_the_simulated_time_of_the_node(plugin):
    text = """
        @neuros_tick(seconds=0.5, outputs="clock")
        def step(node):
            clock = node.make_packet("clock")
            clock.clock.sec, clock.clock.nanosec = 3, 250_000_000
            return clock
    """
    bench = PluginHarness(plugin(text), outputs={"clock": "rosgraph_msgs/msg/Clock"})
    assert bench.sim_time_s is None
    bench.advance(0.5)
    assert bench.sim_time_s == 3.25


def test_the_time_of_a_simulator_counts_more_than_the_clock_that_it_publishes(plugin):
    text = """
        @neuros_tick(seconds=0.5, outputs="clock")
        def step(node):
            node.own_simulated_time(lambda: 3.26)
            clock = node.make_packet("clock")
            clock.clock.sec, clock.clock.nanosec = 3, 250_000_000
            return clock
    """
    bench = PluginHarness(plugin(text), outputs={"clock": "rosgraph_msgs/msg/Clock"})
    bench.advance(0.5)
    assert bench.sim_time_s == 3.26


def test_a_simulator_may_own_the_time(plugin):
    bench = echo(plugin)
    bench.node.own_simulated_time(lambda: 1.5)
    assert bench.sim_time_s == 1.5
