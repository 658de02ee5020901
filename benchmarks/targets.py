"""What NeuROS has to reach, row by row, and which subject measures it.

All figures hold on a machine with 2 cores; ratios are within the same run. A row is met when the
95 % interval of the median (of the ratios, or of the values where there is no reference) over at
least 10 rounds reaches the limit.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Bound:
    """At most, or at least, this much.

    Attributes:
        key: what cases name it by.
        limit: for the ratio to the reference of the case, or for its value (in its unit) where it
            has none; ``None`` where there is a goal only.
        goal: what is hoped for.
        label: which figure of the target, where there are several.
    """

    key: str
    limit: float | None
    is_maximum: bool = True
    goal: float | None = None
    unit: str = ""
    label: str = ""

    def text(self, limit: float) -> str:
        """``limit`` as a condition."""
        return f"{'<=' if self.is_maximum else '>='} {limit:,g} {self.unit}".rstrip()


@dataclass(frozen=True)
class Target:
    """One row: what, compared with what, measured by which subject, and its bounds."""

    what: str
    reference: str
    subject: str
    bounds: tuple[Bound, ...]


TARGETS = (
    Target(
        "acknowledged lossless round trip, small packet, two processes on two cores",
        "bare rclpy.spin without acknowledgements, placed alike",
        "round_trip",
        (Bound("round-trip-core-each", 0.95, goal=0.8),),
    ),
    Target(
        "acknowledged lossless round trip, small packet, two processes on one core",
        "bare rclpy.spin without acknowledgements, placed alike",
        "round_trip",
        (Bound("round-trip-one-core", 0.5),),
    ),
    Target(
        "acknowledged lossless round trip, small packet, two processes, unpinned",
        "dora-rs",
        "round_trip",
        (Bound("round-trip-unpinned", 0.8),),
    ),
    Target(
        "round trip in one process, hook to hook, lossless",
        "bare rclpy, two nodes in one executor",
        "round_trip",
        (Bound("round-trip-in-process", 0.25),),
    ),
    Target(
        "execution of a hook that does nothing (free-running)",
        "",
        "engine",
        (Bound("hook", 10, unit="us"),),
    ),
    Target(
        "921,600 B there, small packet back, two processes, lossless",
        "dora-rs (shared memory)",
        "round_trip",
        (
            Bound("large-packet", 1.3, goal=1.0, label="median"),
            Bound("large-packet-p99", 5000, unit="us", label="p99"),
        ),
    ),
    Target(
        "WhiskEye strict, process back end",
        "one loop without a framework",
        "whiskeye",
        (
            Bound("whiskeye-strict-process", 0.97, is_maximum=False),
            Bound(
                "whiskeye-strict-process-overlap",
                None,
                is_maximum=False,
                goal=0.95,
                label="against the overlap bound",
            ),
        ),
    ),
    Target(
        "WhiskEye strict, in process",
        "one loop without a framework",
        "whiskeye",
        (Bound("whiskeye-strict-in-process", 0.93, is_maximum=False),),
    ),
    Target(
        "WhiskEye hybrid, process back end",
        "one loop without a framework",
        "whiskeye",
        (Bound("whiskeye-hybrid", 1.0, is_maximum=False),),
    ),
    Target(
        "WhiskEye strict, process back end, in virtual time",
        "in real time",
        "virtual_time",
        (Bound("virtual-time", 1.15),),
    ),
    Target(
        "WhiskEye without discard limit: IMU packets consumed per second",
        "WhiskEye strict",
        "whiskeye",
        (Bound("whiskeye-no-discard-limit", 0.95, is_maximum=False),),
    ),
    Target(
        "tick at 20 ms",
        "bare rclpy timer",
        "tick",
        (
            Bound("tick-share", 1.0, is_maximum=False, label="share within 1 ms"),
            Bound("tick-deviation", 1.1, label="standard deviation"),
        ),
    ),
    Target(
        "overloaded node, process: greatest age of a command beside a camera",
        "bare rclpy, with its better executor",
        "overload",
        (
            Bound("overload-age", 1.1, label="age of a command"),
            Bound("overload-wait", 1.1, label="longest wait of one of two inputs"),
        ),
    ),
    Target(
        "WhiskEye from the command to its first hook",
        "",
        "start_up",
        (
            Bound("first-hook-process", 3.0, unit="s", label="process"),
            Bound("first-hook-in-process", 1.5, unit="s", label="in process"),
        ),
    ),
    Target(
        "WhiskEye strict, a container per node",
        "a process per node",
        "containers",
        (Bound("containers-speed", 0.9, is_maximum=False),),
    ),
    Target(
        "WhiskEye in containers from the command to the first hook of every node",
        "",
        "containers",
        (Bound("containers-first-hook", 4.0, unit="s"),),
    ),
    Target(
        "memory per node (process), beyond a bare rclpy node",
        "bare rclpy node",
        "memory",
        (Bound("memory", 10, unit="MB"),),
    ),
    Target(
        "idle project of 3 nodes: share of a core",
        "",
        "idle",
        (Bound("idle", 0.01),),
    ),
    Target(
        "WhiskEye with everything recorded: share of its speed without recording",
        "",
        "recording",
        (
            Bound("recorded-hybrid", 0.95, is_maximum=False, label="hybrid"),
            Bound("recorded-strict", 0.95, is_maximum=False, label="strict"),
        ),
    ),
    Target(
        "recorder: from the spool into the bag",
        "",
        "recording",
        (
            Bound("recorder-packets", 20_000, is_maximum=False, unit="1/s", label="IMU packets"),
            Bound(
                "recorder-live",
                20_000,
                is_maximum=False,
                unit="1/s",
                label="IMU packets, live",
            ),
            Bound("recorder-volume", 120, is_maximum=False, unit="MB/s", label="VGA images"),
        ),
    ),
    Target(
        "WhiskEye strict, in process, with metrics: share of its speed without metrics",
        "",
        "ledger",
        (Bound("ledger", 0.98, is_maximum=False),),
    ),
    Target(
        "slow-down of a ring of 16 nodes against a ring of 2, packets/s",
        "slow-down of the rings in bare rclpy",
        "rings",
        (Bound("ring", 1.0),),
    ),
)

BOUNDS = {bound.key: bound for target in TARGETS for bound in target.bounds}
