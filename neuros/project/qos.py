"""Quality of service of an external topic: ROS's policies, and presets by ROS's names.

A connection has none to choose: its quality of service follows from its discard limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

DEPTH = 10
"""The default depth, that of ROS's default profile."""


@dataclass(frozen=True)
class Qos:
    """The quality of service that an output offers, or an input requests, on an external topic.

    Attributes:
        reliability: ``reliable``, ``best_effort``, ``system_default`` or ``best_available``.
        durability: ``volatile``, ``transient_local``, ``system_default`` or ``best_available``.
        depth: of the queue, in packets; 0: the default of the middleware.
    """

    reliability: str
    durability: str = "volatile"
    depth: int = DEPTH

    @property
    def is_latched(self) -> bool:
        """Whether the last packets also reach later subscribers."""
        return self.durability == "transient_local"


PRESETS: Mapping[str, Qos] = {
    "default": Qos("reliable"),
    "system_default": Qos("system_default", "system_default", 0),
    "sensor_data": Qos("best_effort", depth=5),
    "services_default": Qos("reliable"),
    "parameters": Qos("reliable", depth=1000),
    "parameter_events": Qos("reliable", depth=1000),
    "action_status_default": Qos("reliable", "transient_local", 1),
    "best_available": Qos("best_available", "best_available"),
}
"""As in ``rclpy.qos.QoSPresetProfiles``."""

OFFERED = Qos("reliable")
"""The default of an output: that of ROS."""

ASKED = Qos("best_effort")
"""The default of an input: it matches reliable and best-effort publishers."""


def qos_of(written: Any, *, is_input: bool) -> Qos:
    """The quality of service that a valid ``"qos"`` describes.

    Missing keys have their defaults. A latched input is reliable by default: a best-effort one
    would not get earlier packets.
    """
    if isinstance(written, str):
        return PRESETS[written]
    default = ASKED if is_input else OFFERED
    durability = written.get("durability", default.durability)
    is_latched = durability == "transient_local"
    return Qos(
        written.get("reliability", "reliable" if is_latched else default.reliability),
        durability,
        int(written.get("depth", DEPTH)),
    )


def qos_to_json(qos: Qos) -> Any:
    """Quality of service as JSON: a preset by its name."""
    for name, preset in PRESETS.items():
        if preset == qos:
            return name
    return {"reliability": qos.reliability, "durability": qos.durability, "depth": qos.depth}
