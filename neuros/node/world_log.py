"""The log of a simulated world: how it has moved in a recorded run, for ``neuros report`` to show.

``<node>/world.jsonl`` has a JSON object per line: ``version`` of the geometry; ``geometry``, as
JSON text, where that is another one than in the line before; ``frames``: lists of wall and
simulated time in seconds, and poses (see :mod:`neuros.simulators.mujoco.scene`).
"""

from __future__ import annotations

import json
import threading
from pathlib import Path

from neuros.ports import Logger, WorldLook

FILE = "world.jsonl"
_ASKER = -1  # observers have numbers from 1


class WorldLog:
    """Writes the world of one node, about once per second. ``folder`` is the node's own."""

    def __init__(self, folder: Path, logger: Logger) -> None:
        self._file = folder / FILE
        self._logger = logger
        self._version: str | None = None
        self._is_broken = False
        self._lock = threading.Lock()

    def write(self, look: WorldLook) -> None:
        """Add the frames since the last time. Any thread; what fails ends the log, not the run."""
        with self._lock:
            if self._is_broken:
                return
            try:
                seen = dict(look({"frames": True}, _ASKER))
                if seen["version"] != self._version:
                    seen |= look({"geometry": True}, _ASKER)
                    self._version = seen["version"]
                with self._file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(seen) + "\n")
            except Exception as error:
                self._is_broken = True
                self._logger.warning(f"the world is not recorded any more: {error}")
