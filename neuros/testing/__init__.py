"""Test tools: :class:`PluginHarness` runs one plugin on the real engine, without ROS processes."""

from neuros.runtime.local import Record
from neuros.testing.harness import PluginHarness
from neuros.testing.stand_ins import wire

__all__ = ["PluginHarness", "Record", "wire"]
