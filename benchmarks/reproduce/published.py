"""What was published: chapter 4 of the dissertation that NeuROS 1.0 comes from.

Measured on other machines and with another simulator (Gazebo, and the Neurorobotics Platform that
it was compared with). Where a figure of an orchestration was not published there is no entry.
"""

from __future__ import annotations

from dataclasses import dataclass

NRP = "Neurorobotics Platform"


@dataclass(frozen=True)
class Known:
    """A published figure; ``is_below``: all that is known is that it was less."""

    value: float
    is_below: bool = False

    def __str__(self) -> str:
        return f"{'< ' if self.is_below else ''}{self.value:g}"


SPEED_PERCENT = {
    NRP: Known(14),
    "hybrid": Known(20),
    "asynchronous": Known(25),
    "strict": Known(1, is_below=True),
}
"""Simulated time in per cent of wall time."""

DELIVERY_PERCENT = {
    "strict": Known(100),
    "no_discard_limit": Known(40, is_below=True),
    "asynchronous": Known(40, is_below=True),
}
"""Packets of all connections that were consumed: a hook started on them."""

IMU_DELIVERY_PERCENT = {
    "strict": Known(100),
    "no_discard_limit": Known(100),
    "asynchronous": Known(100),
}
"""The same of the connection of the IMU."""

CPU_PERCENT = {NRP: Known(95), "hybrid": Known(62)}
"""Processor load; taken to be of the whole machine."""

HEADING = {"rms_deg": 5.4, "mean_deg": -3.5, "max_deg": 13.1, "gain": 1.0034}
"""Error of the estimated heading; orchestrations differed by less than 0.05 degrees RMS."""

TICKS = {
    "neuros": {1: 61.1, 2: 88.2, 5: 99.7, 10: 100.0},
    "rclpy": {1: 73.6, 2: 97.0, 5: 100.0, 10: 100.0},
}
"""Per cent of the ticks that were off by no more than so many milliseconds."""

TICK_STD_MS = {"neuros": 1.3, "rclpy": 0.9}
