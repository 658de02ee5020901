"""MuJoCo as a library: sensors and actuators are declared in the node file, not in the plugin.

An output has a sensor behind it::

    {"name": "imu", "type": "sensor_msgs/msg/Imu",
     "mujoco": {"sensor": "imu", "element": "head", "rate": 50}}

================  ======================  =================================================
``sensor``        ``element``             message types
================  ======================  =================================================
``imu``           site or body            ``sensor_msgs/Imu``
``pose``          site or body            ``geometry_msgs/PoseStamped``, ``Pose``
``joint_states``  joints, or none: all    ``sensor_msgs/JointState``
``contacts``      geom or body            ``std_msgs/Bool``, ``Float64``,
                                          ``Float64MultiArray`` (list of elements),
                                          ``geometry_msgs/WrenchStamped``
``camera``        camera                  ``sensor_msgs/Image`` (``width``, ``height``)
``clock``         none                    ``rosgraph_msgs/Clock``
================  ======================  =================================================

``rate`` is in firings per simulated second; its period must be a whole number of timesteps.
An input drives actuators: ``{"actuator": NAME}`` or ``{"actuators": [NAME, ...]}``; see
:mod:`neuros.simulators.mujoco.commands` for the message types, and for drives: actuators that it
declares for joints without any.
"""

import neuros.simulators.convert  # noqa: F401 (imports MuJoCo without OpenGL where that does not work)
from neuros.simulators.mujoco.simulator import MuJoCo

__all__ = ["MuJoCo"]
