"""NeuROS: closed perception-action loops of simulators, spiking networks and robots, on ROS 2.

Plugins import what they declare with from :mod:`neuros.hooks`; everything else reaches them
through the ``node`` object that every hook receives.
"""

__version__ = "2.0.0"
