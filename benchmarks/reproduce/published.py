"""What was published: the results that the sources of NeuROS 1.0 bring along.

They are in ``results_data`` there (``console_output.txt`` has the summary), the code that computed
them in ``metrics``. Measured on a machine with four cores and with another simulator (Gazebo, and
the Neurorobotics Platform that it was compared with). Where a figure of a part was not published
there is no entry.
"""

from __future__ import annotations

NRP = "Neurorobotics Platform"


SPEED_PERCENT = {
    NRP: 14.0,
    "tick_20ms_1ms": 4.95,
    "tick_60ms_1ms": 1.66,
    "tick_100ms_1ms": 1.00,
    "strict": 0.18,
    "no_discard_limit": 21.1,
    "asynchronous": 25.4,
    "hybrid": 19.9,
}
"""Simulated time in per cent of wall time."""

_DELIVERED_PERCENT = {
    "tick_20ms_1ms": (98.8, 16.4, 16.4),
    "tick_60ms_1ms": (100, 30.6, 29.8),
    "tick_100ms_1ms": (100, 40.2, 38.5),
    "strict": (100, 100, 100),
    "no_discard_limit": (100, 6.89, 6.89),
    "asynchronous": (100, 5.69, 5.69),
    "hybrid": (100, 7.09, 7.09),
}

DELIVERY_PERCENT = {
    connection: {name: shares[place] for name, shares in _DELIVERED_PERCENT.items()}
    for place, connection in enumerate(("imu", "pose", "estimate"))
}
"""Packets that were consumed (a hook started on them), of those sent, by connection."""

CPU_PERCENT = {
    NRP: 92.5,
    "tick_20ms_1ms": 44.7,
    "tick_60ms_1ms": 30.8,
    "tick_100ms_1ms": 20.7,
    "strict": 29.3,
    "no_discard_limit": 61.7,
    "asynchronous": 79.0,
    "hybrid": 63.2,
}
"""Processor load of the whole machine: the mean of its cores."""

HEADING = {"rms_deg": 5.4, "mean_deg": -3.5, "max_deg": 13.1, "gain": 1.0034}
"""Error of the estimated heading; orchestrations differed by less than 0.05 degrees RMS."""

HEAD_DIRECTION = {
    "published, NeuROS 1.0": {
        "simulated_s": 20.0,
        "uncorrected_rms_deg": HEADING["rms_deg"],
        "uncorrected_max_deg": HEADING["max_deg"],
    },
    "published, Stentiford et al. 2022": {"simulated_s": 161.6, "corrected_rms_deg": 5.2},
}
"""Error of a ring alone, and of one that a convolutional network corrects (0.0907 rad)."""

TICKS = {
    "neuros": {1: 61.1, 2: 88.2, 5: 99.7, 10: 100.0},
    "rclpy": {1: 73.6, 2: 97.0, 5: 100.0, 10: 100.0},
}
"""Per cent of the ticks that were off by no more than so many milliseconds."""

TICK_FIGURES = {
    "neuros": {"intervals": 296, "mean_ms": 999.994, "std_ms": 1.30},
    "rclpy": {"intervals": 296, "mean_ms": 1000.002, "std_ms": 0.89},
}
"""Intervals of ticks of 1 s."""

VOTING = {"intervals": 57, "mean_s": 5.0216, "std_ms": 1.70}
"""Intervals between questions; three voters think for 5 s each, at the same time."""

ELEVATOR_SPEED_PERCENT = {
    "strict": 17.4,
    "no_discard_limit": 19.5,
    "asynchronous": 29.7,
}
"""Simulated time in per cent of wall time."""

ELEVATOR_CPU_PERCENT = {
    "strict": 72.6,
    "no_discard_limit": 71.1,
    "asynchronous": 80.8,
}
"""Processor load of the whole machine: the mean of its cores."""
