"""For tests of plugins, and of the transports and back ends that NeuROS can be extended with.

:class:`PluginHarness` runs one plugin on the real engine, without ROS processes and without a
launcher; :class:`~neuros.testing.transports.TransportChecks` is the suite that every transport
passes.
"""

from neuros.testing.harness import PluginHarness
from neuros.testing.stand_ins import Record
from neuros.testing.wiring import wire

__all__ = ["PluginHarness", "Record", "wire"]
