"""Test tools: a harness for plugins, and the suite of checks for transports.

:class:`PluginHarness` runs one plugin on the real engine, without ROS processes and without a
launcher; :class:`~neuros.testing.transports.TransportChecks` is the suite that every transport
passes.
"""

from neuros.testing.harness import PluginHarness
from neuros.testing.stand_ins import Record, wire

__all__ = ["PluginHarness", "Record", "wire"]
