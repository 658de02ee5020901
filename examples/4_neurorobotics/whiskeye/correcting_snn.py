"""What the variants of the corrected network share: its start, and what it does with packets."""

from __future__ import annotations

import math
import os
from typing import Any

from correction import GATE, CorrectedIntegrator

from neuros.time import to_nanoseconds


def start_integrator(node: Any) -> None:
    """Make the rings of the node.

    SEED, GYRO_BIAS in rad/s, CORRECTION_PA, GATE, LEARNING, and START_DEG: how far off they start.
    """
    node.set_user_data(
        CorrectedIntegrator(
            int(os.environ.get("SEED", "1")),
            float(os.environ.get("GYRO_BIAS", "0")),
            float(os.environ.get("CORRECTION_PA", "300")),
            float(os.environ.get("GATE", str(GATE))),
            float(os.environ.get("LEARNING", "0")),
            math.radians(float(os.environ.get("START_DEG", "0"))),
        )
    )


def estimates(node: Any, imu: Any, odom_correction: Any) -> tuple[Any, Any, Any]:
    """The packets ``estimate`` and ``uncorrected``, with the stamp of the IMU's packet, and
    ``activity``: the bump of the ring that is corrected.
    """
    integrator = node.get_user_data()
    if odom_correction is not None:
        seen = odom_correction.vector
        integrator.vision.see(to_nanoseconds(odom_correction), seen.z, seen.x, seen.y)
    headings_rad = integrator.integrate(to_nanoseconds(imu), imu.angular_velocity.z)
    packets = node.make_packet("estimate"), node.make_packet("uncorrected")
    for packet, heading_rad in zip(packets, headings_rad, strict=True):
        packet.header.stamp, packet.header.frame_id = imu.header.stamp, "world"
        packet.vector.z = heading_rad
    activity = node.make_packet("activity")
    activity.data = integrator.corrected.activity.astype(float)
    return *packets, activity
