"""End of the ROS nodes of a context, without the hang of Fast DDS.

When rmw_fastrtps destroys the participant of a context, it takes away its listener first and waits
until no callback runs there. Fast DDS (2.14 to 2.14.6, ``DomainParticipantImpl::set_listener``)
waits until the largest time there is. Where the C++ library turns that into a time of another
clock, as in the wheels, it overflows: the wait returns at once, again and again, and never lets go
of the lock that the callback needs for its end. So a process that ends while DDS tells it that
another ends, as all nodes of a project do, may hang, with a busy core and with Python's global
lock. A finite time does not overflow, and once the listener is gone nothing waits for it any more.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable

import rclpy
from rclpy.context import Context
from rclpy.node import Node as RosNode

_RMW = "librmw_fastrtps_cpp.so"
_PARTICIPANT = "_ZN16rmw_fastrtps_cpp22get_domain_participantEP10rmw_node_s"
_SET_LISTENER = (
    "_ZN8eprosima7fastdds3dds17DomainParticipant12set_listenerEPNS1_25DomainParticipantListener"
    "ENSt6chrono8durationIlSt5ratioILl1ELl1EEEE"
)
_LONGEST_S = 2
"""For a callback of discovery, which takes microseconds."""


def give_up(context: Context, ros_nodes: Iterable[RosNode]) -> None:
    """Destroy all nodes of a context, and shut it down."""
    ros_nodes = list(ros_nodes)
    if ros_nodes:
        end_discovery(ros_nodes[0])  # they have one participant
    for ros_node in ros_nodes:
        ros_node.destroy_node()
    rclpy.shutdown(context=context)


def end_discovery(ros_node: RosNode) -> None:
    """Remove the listener of a node's participant; does nothing with another RMW."""
    try:
        rmw = ctypes.CDLL(_RMW, mode=os.RTLD_NOLOAD | os.RTLD_LAZY)
        get_rmw_node = ctypes.CDLL("librcl.so", mode=os.RTLD_NOLOAD).rcl_node_get_rmw_handle
        get_participant, set_listener = rmw[_PARTICIPANT], rmw[_SET_LISTENER]
    except (OSError, AttributeError):
        return
    for function in (get_rmw_node, get_participant):
        function.argtypes, function.restype = [ctypes.c_void_p], ctypes.c_void_p
    set_listener.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64]
    with ros_node.handle:  # it exists meanwhile
        participant = get_participant(get_rmw_node(ros_node.handle.pointer))
        if participant:
            set_listener(participant, None, _LONGEST_S)
