"""Recorded packets and figures of runs as frames of pandas and datasets of xarray.

Units are those of the definitions of ROS messages (REP 103); a field whose unit depends on other
data, as the position of a joint, has none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import pandas as pd

from neuros.api.run_record import PastRun
from neuros.bag import RecordedTopic
from neuros.errors import UsageError
from neuros.recording.columns import (
    IMAGE,
    LOG_TIME,
    PIXELS,
    PUBLISH_TIME,
    fields_of,
    has_simulated_time,
    pixels_of,
)

_LATENCIES = ("p50", "p90", "p99", "max")
_SUMMED = ("executing", "waiting", "blocked")
_MOST_COLUMNS = 100
_UNITS = {
    "builtin_interfaces/msg/Duration": {"sec": "s", "nanosec": "ns"},
    "builtin_interfaces/msg/Time": {"sec": "s", "nanosec": "ns"},
    "geometry_msgs/msg/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/msg/Pose": {"position": "m"},
    "geometry_msgs/msg/Transform": {"translation": "m"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/Wrench": {"force": "N", "torque": "N m"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa", "variance": "Pa^2"},
    "sensor_msgs/msg/Illuminance": {"illuminance": "lx", "variance": "lx^2"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "sensor_msgs/msg/LaserScan": {
        **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
        **dict.fromkeys(("time_increment", "scan_time"), "s"),
        **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
    },
    "sensor_msgs/msg/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/msg/Range": {
        "field_of_view": "rad",
        **dict.fromkeys(("min_range", "max_range", "range"), "m"),
    },
    "sensor_msgs/msg/Temperature": {"temperature": "degC", "variance": "degC^2"},
}


def connections(run: PastRun) -> Any:
    """A row for each connection: its figures with those of its latency, without digests."""
    rows = []
    for figures in run.connections.values():
        latency = figures.get("latency_ms") or {}
        plain = {k: v for k, v in figures.items() if k not in ("latency_ms", "digests", "index")}
        rows.append(plain | {f"latency_{name}_ms": latency.get(name) for name in _LATENCIES})
    made = pd.DataFrame(rows)
    return made if made.empty else made.set_index("connection")


def nodes(run: PastRun) -> Any:
    """A row for each node: seconds by cause, executions, simulated time, results."""
    rows = {}
    for name, node in run.nodes.items():
        spent, hooks = node.get("accounting") or {}, node.get("hooks") or {}
        row = {f"{kind}_s": sum(spent[kind].values()) for kind in _SUMMED if kind in spent}
        row |= {"idle_s": spent["idle"], "total_s": spent["total"]} if spent else {}
        row["executions"] = sum(hook["executions"] for hook in hooks.values())
        rows[name] = {**row, **node.get("results", {})}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("node")


def frame(topic: RecordedTopic, clock: Literal["wall", "sim"]) -> Any:
    """The result of :meth:`RecordedTopic.frame`."""
    spread: dict[str, Any] = {}
    columns = topic.columns()
    for name, column in columns.items():
        elements = math.prod(column.shape[1:])
        if column.ndim == 1:
            spread[name] = column
        elif elements <= _MOST_COLUMNS:
            for place, single in enumerate(column.reshape(len(column), elements).T):
                spread[f"{name}[{place}]"] = single
        else:
            spread[name] = list(column)
    if clock == "sim":
        if not (topic.is_virtual or has_simulated_time(columns)):
            raise UsageError(
                f"{topic.name} has no simulated time: no node of the run owns time, or the bag"
                ' is no MCAP file, and others have no place for it. Use clock="wall"'
            )
        time = pd.to_timedelta(columns[PUBLISH_TIME], unit="ns")
    elif topic.is_virtual:
        time = pd.to_timedelta(columns[LOG_TIME], unit="ns")
    else:
        time = pd.to_datetime(columns[LOG_TIME], unit="ns", utc=True)
    return pd.DataFrame(spread, index=time.rename("time"))


def dataset(topic: RecordedTopic, types: Mapping[str, Any], start_ns: int) -> Any:
    """The result of :meth:`RecordedTopic.xarray`.

    Args:
        types: the field definitions of the bag's types.
        start_ns: wall time of the bag's first packet.
    """
    import xarray as xr

    columns = topic.columns()
    is_simulated = has_simulated_time(columns)
    wall_ns, sim_ns = columns.pop(LOG_TIME), columns.pop(PUBLISH_TIME)
    if is_simulated:
        time_s, clock = sim_ns / 1e9, "simulated time"
    elif topic.is_virtual:
        time_s, clock = wall_ns / 1e9, "virtual time"
    else:
        time_s, clock = (wall_ns - start_ns) / 1e9, "wall time since the first packet of the bag"
    found = {".".join(name for _, name in way): way for way in fields_of(topic.type, types)}
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {
        "time": ("time", time_s, {"units": "s", "long_name": clock}),
        "virtual_time" if topic.is_virtual else "wall_time": (
            "time",
            wall_ns.astype("timedelta64[ns]" if topic.is_virtual else "datetime64[ns]"),
        ),
    }
    images = [name for name, way in found.items() if way[-1] == (IMAGE, "data")]
    for name in images:
        prefix = name.removesuffix("data")
        if (pixels := pixels_of(columns, prefix)) is not None:
            dims = [f"{prefix}{dim}" for dim in ("y", "x", "channel")][: pixels.ndim - 1]
            variables[name] = (("time", *dims), pixels)
            if pixels.ndim == 4:
                channels = list(PIXELS[str(columns[f"{prefix}encoding"][0])][1])
                coordinates[dims[2]] = (dims[2], channels)
            del columns[name]
    for name, column in columns.items():
        units = (_UNITS.get(of, {}).get(field) for of, field in reversed(found.get(name, ())))
        unit = next(filter(None, units), None)
        dims = [f"{name}_{axis}" for axis in range(column.ndim - 1)]
        free = f"{name}_" if name in coordinates else name
        variables[free] = (("time", *dims), column, {"units": unit} if unit else {})
    label = {"connection": topic.connection} if topic.connection else {}
    return xr.Dataset(variables, coordinates, {"topic": topic.name, "type": topic.type, **label})
