"""The load of a machine and of the nodes of a run, for somebody who looks at it now."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from neuros.observe.monitor import Meter


class LoadNow:
    """Tells what has been used since it was last asked.

    Args:
        clock: monotonic, seconds.
    """

    def __init__(self, meter: Meter, clock: Callable[[], float] = time.monotonic) -> None:
        self._meter = meter
        self._clock = clock
        self._before: dict[str, float] = {}
        self._before_s = clock()

    def __call__(self) -> dict[str, Any]:
        """Percent of a core, bytes and threads, of the machine and by group; JSON-serialisable."""
        machine, groups, now_s = self._meter.machine(), self._meter.groups(), self._clock()
        passed_s = max(now_s - self._before_s, 1e-6)
        shown = {
            name: {
                "cpu_percent": 100.0
                * max(0.0, load.cpu_s - self._before.get(name, load.cpu_s))
                / passed_s,
                "memory_bytes": load.memory_bytes,
                "threads": load.threads,
            }
            for name, load in groups.items()
        }
        self._before, self._before_s = {n: g.cpu_s for n, g in groups.items()}, now_s
        return {
            "cores": list(machine.core_percent),
            "memory_percent": machine.memory_percent,
            "memory_used_bytes": machine.memory_used_bytes,
            "groups": shown,
        }
