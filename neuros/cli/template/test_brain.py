"""A test of one plugin, without the other nodes: run it with pytest."""

from pathlib import Path

from std_msgs.msg import Float64

from neuros.testing import PluginHarness


def test_the_brain_turns_back():
    with PluginHarness.from_project(Path(__file__).parent, "brain") as brain:
        brain.send("heading", Float64(data=0.5))
        brain.run()
        assert brain.received("turn") == [Float64(data=-1.0)]
