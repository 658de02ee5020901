"""Once per second a row of a CSV file: what the machine does, and what each node takes of it."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from neuros.observe.load import GroupLoad, MachineLoad
from neuros.observe.load_table import FILE_NAME, LoadTable

PERIOD_S = 1.0


class Meter(Protocol):
    """Where the figures come from: :class:`neuros.observe.load.LoadMeter`."""

    def machine(self) -> MachineLoad: ...
    def groups(self) -> Mapping[str, GroupLoad]: ...


class LoadMonitor(threading.Thread):
    """Writes ``system_load.csv`` in a run folder until :meth:`stop`.

    Attributes:
        failure: why nothing more is written, ``None`` while all is well.
    """

    def __init__(
        self, folder: Path, meter: Meter, table: LoadTable, period_s: float = PERIOD_S
    ) -> None:
        super().__init__(name="neuros-monitor", daemon=True)
        self._path = folder / FILE_NAME
        self._meter = meter
        self._table = table
        self._period_s = period_s
        self._ended = threading.Event()
        self.failure: str | None = None

    def run(self) -> None:
        """Write rows until the end, or until there is no room for them."""
        try:
            with open(self._path, "w", newline="", encoding="utf-8") as file:
                self._write(csv.writer(file), file.flush)
        except OSError as error:
            self.failure = (
                f"{self._path} could not be written to ({error.strerror}): the system load was not"
                " recorded to the end"
            )

    def stop(self) -> dict[str, Any]:
        """Write no further row; returns the summary."""
        self._ended.set()
        self.join()
        return self._table.summary()

    def _write(self, writer: Any, flush: Callable[[], None]) -> None:
        writer.writerow(self._table.header)
        flush()
        start_s = time.monotonic()
        self._table.begin(start_s, self._meter.machine(), self._meter.groups())
        due_s = start_s + self._period_s
        while not self._ended.wait(max(0.0, due_s - time.monotonic())):
            now_s = time.monotonic()
            cells = self._table.row(now_s, self._meter.machine(), self._meter.groups())
            writer.writerow([f"{now_s - start_s:.3f}", f"{time.time():.3f}", *cells])
            flush()
            due_s = max(due_s + self._period_s, now_s)
