"""Within one process, each receiver gets a copy of a packet."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from geometry_msgs.msg import PointStamped
from std_msgs.msg import Int32

from neuros.testing import PluginHarness

INT, POINT = "std_msgs/msg/Int32", "geometry_msgs/msg/PointStamped"


@pytest.fixture
def harness(tmp_path: Path) -> Callable[[str], PluginHarness]:
    def make(text: str) -> PluginHarness:
        path = tmp_path / "plugin.py"
        path.write_text("from neuros.hooks import *\n" + textwrap.dedent(text))
        return PluginHarness(path, inputs={"x": INT, "w": POINT}, outputs={"y": POINT, "z": POINT})

    return make


def run_twice(bench: PluginHarness) -> None:
    for _ in range(2):
        bench.send("x", Int32())
        bench.run()


@pytest.mark.parametrize(
    "kept",
    [
        "packet",
        "packet.point",
        "packet.header.stamp",
        "[{'deep': packet}]",
        "(lambda: packet)",
        "(each for each in [packet])",
    ],
)
def test_what_a_hook_keeps_and_changes_later_has_no_effect_on_what_it_has_sent(harness, kept):
    bench = harness(f"""
        packets = []

        @neuros_function(inputs="x", outputs="y")
        def step(node, x):
            for earlier in packets:
                change(earlier)
            packet = node.make_packet("y")
            packets.append({kept})
            return packet

        def change(kept):
            if isinstance(kept, list):
                kept = kept[0]["deep"]
            elif callable(kept):
                kept = kept()
            elif hasattr(kept, "__next__"):
                kept = next(kept, None)
            if hasattr(kept, "point"):
                kept.header.frame_id = "changed"
                kept.point.x = 9.0
            elif hasattr(kept, "x"):
                kept.x = 9.0
            elif kept is not None:
                kept.sec = 9
    """)
    run_twice(bench)
    assert bench.received("y") == [PointStamped(), PointStamped()]


def test_a_list_of_packets_that_the_hook_returns_again_is_copied(harness):
    bench = harness("""
        @neuros_initialise()
        def start(node):
            node.set_user_data([node.make_packet("y"), node.make_packet("z")])

        @neuros_function(inputs="x", outputs=["y", "z"])
        def step(node, x):
            packets = node.get_user_data()
            packets[0].point.x += 1.0
            return packets
    """)
    run_twice(bench)
    assert [packet.point.x for packet in bench.received("y")] == [1.0, 2.0]


def test_one_packet_for_two_outputs_reaches_each_receiver_by_itself(harness):
    bench = harness("""
        @neuros_function(inputs="x", outputs=["y", "z"])
        def step(node, x):
            packet = node.make_packet("y")
            return packet, packet
    """)
    bench.send("x", Int32())
    bench.run()
    assert bench.received("y")[0] is not bench.received("z")[0]


@pytest.mark.parametrize("kept", ["None", "node.set_user_data(x)"])
def test_a_packet_that_a_hook_returns_as_it_came_is_copied(harness, kept):
    bench = harness(f"""
        @neuros_function(inputs="w", outputs="y")
        def step(node, x):
            (node.run_dir / "came").write_text(str(id(x)))
            {kept}
            return x
    """)
    sent = PointStamped()
    sent.point.x = 3.0
    bench.send("w", sent)
    bench.run()
    (received,) = bench.received("y")
    assert received == sent
    assert str(id(received)) != (bench.run_dir / "came").read_text()
