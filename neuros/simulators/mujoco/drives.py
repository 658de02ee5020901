"""Drives: actuators that a node file declares for joints of a model without any, as URDF has none.

``{"joint": "elbow", "drive": "position", "kp": 50, "kv": 5, "force_limit": 10}``

============  =====================  ==================================================
``drive``     gains                  what a command is
============  =====================  ==================================================
``position``  ``kp``, and ``kv``     where to go: radians or metres
``velocity``  ``kv``                 how fast: per second
``motor``     none                   force or torque: N or N m
============  =====================  ==================================================

``force_limit`` bounds what any of them applies (N or N m).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

_GAINS: Mapping[str, tuple[str, ...]] = {
    "position": ("kp", "kv"),
    "velocity": ("kv",),
    "motor": (),
}
_NEEDED: Mapping[str, tuple[str, ...]] = {"position": ("kp",), "velocity": ("kv",), "motor": ()}
DRIVE_KEYS = ("drive", "kp", "kv", "force_limit")


@dataclass(frozen=True)
class Drive:
    """An actuator for a joint; gains in N/m and N s/m, or N m/rad and N m s/rad."""

    kind: str
    kp: float = 0.0
    kv: float = 0.0
    force_limit: float | None = None


def read_drive(declared: Mapping[str, Any], complain: Callable[[str, str], None]) -> Drive | None:
    """The drive that a node file declares; ``complain`` gets keys and what is wrong with them."""
    kind = declared.get("drive")
    if not isinstance(kind, str) or kind not in _GAINS:
        complain("drive", f"{kind!r} is not one of {', '.join(_GAINS)}")
        return None
    allowed = ("drive", "force_limit", *_GAINS[kind])
    values = {}
    for key in DRIVE_KEYS[1:]:
        if key not in declared:
            if key in _NEEDED[kind]:
                complain(key, f"missing: a {kind} drive needs it")
            continue
        value = declared[key]
        if key not in allowed:
            complain(key, f"a {kind} drive has no {key}")
        elif isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            complain(key, f"{value!r} is not a positive number")
        else:
            values[key] = float(value)
    return Drive(kind, **values)


def add_drive(spec: Any, joint: str, drive: Drive) -> str:
    """Add an actuator called as its joint to an ``MjSpec``; returns what is wrong, or nothing."""
    import mujoco

    if spec.actuator(joint) is not None:
        return f"the model has an actuator '{joint}': name that with 'actuator'"
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if drive.kind == "position":
        actuator.set_to_position(kp=drive.kp, kv=drive.kv)
    elif drive.kind == "velocity":
        actuator.set_to_velocity(kv=drive.kv)
    else:
        actuator.set_to_motor()
    if drive.force_limit is not None:
        actuator.forcelimited = True
        actuator.forcerange = [-drive.force_limit, drive.force_limit]
    return ""
