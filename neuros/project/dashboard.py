"""The key ``"dashboard"`` of a project: the panels of a run's page, and their checks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from neuros.errors import Problem
from neuros.project.message_types import misfit, normalised, ros_type
from neuros.project.parsed import ParsedProject
from neuros.project.scanner import Element
from neuros.project.suggest import did_you_mean, listed

SPIKES = "neuros_msgs/msg/Spikes"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
ARRAYS: Mapping[str, str] = {
    **{
        f"std_msgs/msg/{kind}MultiArray": "data"
        for kind in (f"{sign}Int{n}" for sign in ("", "U") for n in (8, 16, 32, 64))
    },
    "std_msgs/msg/Float32MultiArray": "data",
    "std_msgs/msg/Float64MultiArray": "data",
    "sensor_msgs/msg/JointState": "position",
    "sensor_msgs/msg/LaserScan": "ranges",
}
"""By message type, the array that is drawn unless ``field`` names another one."""

# By panel, the keys that it must have, and those that it may have besides its size.
_KEYS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    **dict.fromkeys(("world", "graph", "details", "connections", "nodes", "log", "load"), ((), ())),
    "series": ((), ("fields",)),
    "images": ((), ("outputs",)),
    "raster": (("output",), ("seconds",)),
    "activity": (("output",), ("field", "seconds")),
}
_SIZE = ("panel", "width", "height")


def dashboard_mistakes(parsed: ParsedProject) -> Iterator[Problem]:
    """Panels that occur twice, keys without meaning, unsuitable outputs and fields."""
    dashboard = parsed.root.member("dashboard")
    types = _types(parsed) if dashboard is not None else {}
    seen: set[str] = set()
    for panel in () if dashboard is None else dashboard.items("panels"):
        kind = panel.string("panel")
        if kind is None or kind not in _KEYS:
            continue
        needed, allowed = _KEYS[kind]
        if not needed and kind in seen:
            yield panel.value["panel"].problem(f"the panel '{kind}' occurs twice")
        seen.add(kind)
        for key in needed:
            if key not in panel.value:
                yield panel.problem(f"the panel '{kind}' needs the key '{key}'")
        for key, member in panel.value.items():
            if key not in (*needed, *allowed, *_SIZE) and key in _ALL_KEYS:
                has = listed([*needed, *allowed, *_SIZE[1:]])
                yield member.key_problem(
                    f"'{key}' has no meaning for the panel '{kind}'", f"it may have {has}"
                )
        for output in (panel.member("output"), *panel.items("outputs")):
            if output is not None and isinstance(output.value, str):
                yield from _misfit(kind, panel, output, types, is_complete=parsed.is_complete)
        path, type_name = panel.string("field"), types.get(panel.string("output") or "", "")
        if kind != "activity" or not path or not normalised(type_name):
            continue
        if wrong := misfit(type_name, path, parsed.roots.packages):
            yield panel.value["field"].problem(*wrong)


def panels_without_effect(parsed: ParsedProject) -> Iterator[Problem]:
    """Panels of earlier versions, which the page leaves out."""
    dashboard = parsed.root.member("dashboard")
    for panel in () if dashboard is None else dashboard.items("panels"):
        if panel.string("panel") == "series":
            text = "the panel 'series' has no effect"
            yield panel.problem(text, "plot numbers with --viewer foxglove")


_ALL_KEYS = {key for needed, allowed in _KEYS.values() for key in (*needed, *allowed)}


def _types(parsed: ParsedProject) -> dict[str, str]:
    """The type of every output, and of every input with an external topic, by NODE.NAME."""
    found: dict[str, str] = {}
    for node in parsed.nodes:
        for side in ("outputs", "inputs"):
            for port in node.items(side):
                name = port.string("name") if side == "outputs" else port.string("external_topic")
                if name is not None:
                    written = port.string("type") or ""
                    found[f"{node.string('name')}.{name}"] = ros_type(
                        normalised(written) or written
                    )
    return found


def _misfit(
    kind: str, panel: Element, output: Element, types: Mapping[str, str], *, is_complete: bool
) -> Iterator[Problem]:
    name = output.value
    if name not in types:
        if is_complete:
            hint = did_you_mean(name, types) or "write NODE.OUTPUT"
            yield output.problem(f"there is no output '{name}'", hint)
        return
    type_name = types[name]
    if kind == "raster" and type_name != SPIKES:
        yield output.problem(f"a raster shows {SPIKES}, but '{name}' is {type_name}")
    elif kind == "images" and type_name not in IMAGES:
        yield output.problem(f"'{name}' is {type_name}, which is not an image")
    elif kind == "activity" and type_name not in (SPIKES, *ARRAYS) and "field" not in panel.value:
        text = f"which array of {type_name} is to be drawn?"
        yield panel.problem(text, "name it with 'field', as \"data\"")
