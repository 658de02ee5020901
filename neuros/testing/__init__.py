"""Test tools: :class:`PluginHarness` runs one plugin on the real engine, without ROS processes."""

from neuros.testing.harness import PluginHarness
from neuros.testing.stand_ins import Record, wire

__all__ = ["PluginHarness", "Record", "wire"]
