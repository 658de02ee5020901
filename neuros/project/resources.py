"""Resource limits of a node, and the devices that its container may use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_UNITS = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30}


@dataclass(frozen=True)
class Resources:
    """Limits of a node; ``None`` is no limit of its own.

    Attributes:
        mem_bytes: memory; what needs more is killed.
        cpus: cores' worth of computing time, 1.5 is one and a half.
        pids: processes and threads at any one time.
    """

    mem_bytes: int | None = None
    cpus: float | None = None
    pids: int | None = None


@dataclass(frozen=True)
class Access:
    """What a container is let in to that it would not see by itself.

    Attributes:
        devices: paths in ``/dev``.
        gpus: ``("all",)``, or the ids of GPUs.
        display: whether it may open windows.
    """

    devices: tuple[str, ...] = ()
    gpus: tuple[str, ...] = ()
    display: bool = False


def memory_text(mem_bytes: int) -> str:
    """An amount of memory as project files write it: ``2g``, ``512m``."""
    for unit, factor in sorted(_UNITS.items(), key=lambda pair: -pair[1]):
        if mem_bytes % factor == 0:
            return f"{mem_bytes // factor}{unit}"
    return f"{-(-mem_bytes // _UNITS['k'])}k"


def resources_of(keys: Mapping[str, Any]) -> Resources:
    """The limits that valid keys of a node set."""
    given = keys.get("resources", {})
    memory, cpus, pids = (given.get(key) for key in ("memory", "cpus", "pids"))
    return Resources(
        mem_bytes=None if memory is None else int(memory[:-1]) * _UNITS[memory[-1]],
        cpus=None if cpus is None else float(cpus),
        pids=None if pids is None else int(pids),
    )


def access_of(keys: Mapping[str, Any]) -> Access:
    """What valid keys of a node open to it."""
    gpus = keys.get("gpus", ())
    return Access(
        devices=tuple(keys.get("devices", ())),
        gpus=(gpus,) if isinstance(gpus, str) else tuple(map(str, gpus)),
        display=bool(keys.get("display", False)),
    )


def keys_of(resources: Resources, access: Access) -> dict[str, Any]:
    """The keys of a node that say this; the inverse of the two above."""
    memory = None if resources.mem_bytes is None else memory_text(resources.mem_bytes)
    limits = {"memory": memory, "cpus": resources.cpus, "pids": resources.pids}
    keys = {
        "resources": {key: limit for key, limit in limits.items() if limit is not None},
        "devices": list(access.devices),
        "gpus": "all" if access.gpus == ("all",) else list(access.gpus),
        "display": access.display,
    }
    return {key: value for key, value in keys.items() if value}
