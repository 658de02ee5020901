"""Settings of Fast DDS and the discovery range of the nodes of a process.

ROS's range ``LOCALHOST`` ("this machine only") brings transports of its own, which announce a
participant to the first 32 of the domain only: of 64 processes some never find each other. So
NeuROS takes the range ``SYSTEM_DEFAULT`` instead, which leaves transports to the settings, and has
settings of equal meaning with room for all 120 participants of a domain. ROS programs of the
user with the ranges ``LOCALHOST`` and ``SUBNET`` find such nodes, and are found.

They use UDP alone. Fast DDS takes shared memory wherever both ends offer it on one host, and then
delivers nothing, without a word, if they do not share user and IPC namespace; and its files are
what many processes that start at once trip over. Large packets have shared memory of NeuROS's own,
which asks first (``large_packets.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

PROFILES_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
"""Names the settings that Fast DDS 2 reads when the first ROS node of a process is created."""

PROFILES = Path(__file__).with_name("fast_dds.xml")
"""NeuROS's settings of Fast DDS for a network: what is lost there is sent again soon."""

LOCAL_PROFILES = Path(__file__).with_name("fast_dds_local.xml")
"""NeuROS's settings with transports that stay on this machine."""

MOST_LOCAL_PARTICIPANTS = 120
"""Processes with ROS nodes that one domain has ports for (DDSI-RTPS 2.5, 9.6.2)."""

RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS_VARIABLE = "ROS_STATIC_PEERS"


_LOCAL = {PROFILES_VARIABLE: str(LOCAL_PROFILES), RANGE_VARIABLE: "SYSTEM_DEFAULT"}


def dds_environment(environ: Mapping[str, str]) -> dict[str, str]:
    """Variables to add to ``environ`` before the first ROS node of a process is created.

    Nothing if it names settings of the user's own. A range other than ``LOCALHOST``, and
    ``LOCALHOST`` with peers on other machines, are left to ROS.
    """
    asked = as_asked(environ)
    if asked.get(PROFILES_VARIABLE):
        return {}
    if asked.get(RANGE_VARIABLE) != "LOCALHOST" or asked.get(PEERS_VARIABLE):
        return {PROFILES_VARIABLE: str(PROFILES)}
    return dict(_LOCAL)


def as_asked(environ: Mapping[str, str]) -> dict[str, str]:
    """``environ`` without what :func:`dds_environment` has added.

    What a node starts inherits that; another run among it has to know what the user wants.
    """
    asked = dict(environ)
    if all(asked.get(key) == value for key, value in _LOCAL.items()):
        asked[RANGE_VARIABLE] = "LOCALHOST"
    if asked.get(PROFILES_VARIABLE) in (str(PROFILES), str(LOCAL_PROFILES)):
        del asked[PROFILES_VARIABLE]
    return asked
