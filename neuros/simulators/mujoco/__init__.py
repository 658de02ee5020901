"""MuJoCo as a library: sensors and actuators are declared in the node file, not in the plugin.

An output has a sensor behind it::

    {"name": "imu", "type": "sensor_msgs/msg/Imu",
     "mujoco": {"sensor": "imu", "element": "head", "rate": 50}}

``rate`` is in firings per simulated second; its period must be a whole number of timesteps.
:mod:`~neuros.simulators.mujoco.sensors` has the kinds of sensors. An input drives actuators:
``{"actuator": NAME}`` or ``{"actuators": [NAME, ...]}``; see
:mod:`~neuros.simulators.mujoco.commands`.
"""

import os

try:
    import mujoco
except Exception:
    # MuJoCo imports the OpenGL that MUJOCO_GL names at once. Only cameras need OpenGL: they report
    # what is missing.
    _chosen = os.environ.get("MUJOCO_GL")
    if not _chosen:
        raise
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco  # noqa: F401
    finally:
        os.environ["MUJOCO_GL"] = _chosen


from neuros.simulators.mujoco.simulator import MuJoCo
from neuros.simulators.mujoco.worlds import MuJoCoWorlds

__all__ = ["MuJoCo", "MuJoCoWorlds"]
