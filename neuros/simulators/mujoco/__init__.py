"""MuJoCo as a library: sensors and actuators are declared in the node file, not in the plugin.

An output has a sensor behind it::

    {"name": "imu", "type": "sensor_msgs/msg/Imu",
     "mujoco": {"sensor": "imu", "element": "head", "rate": 50}}

``rate`` is in firings per simulated second; its period must be a whole number of timesteps.
:mod:`~neuros.simulators.mujoco.sensors` has the kinds of sensors. An input drives actuators:
``{"actuator": NAME}`` or ``{"actuators": [NAME, ...]}``; see
:mod:`~neuros.simulators.mujoco.commands`.
"""

import neuros.simulators.convert  # noqa: F401 (imports MuJoCo without OpenGL where that does not work)
from neuros.simulators.mujoco.simulator import MuJoCo

__all__ = ["MuJoCo"]
