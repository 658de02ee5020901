"""Test tools: :class:`PluginHarness` runs one plugin on the real engine, without ROS processes."""

from neuros.runtime.local import Record
from neuros.testing.harness import PluginHarness, wire

__all__ = ["PluginHarness", "Record", "wire"]
