"""The thread that writes ``system_load.csv``."""

from __future__ import annotations

import csv
import threading
from pathlib import Path

from neuros.observe.load import GroupLoad, MachineLoad
from neuros.observe.load_table import FILE_NAME, LoadTable
from neuros.observe.monitor import LoadMonitor

PERIOD_S = 0.005
DEADLINE_S = 10.0


class Meter:
    """Counts how often it was asked."""

    def __init__(self, enough: int) -> None:
        self._enough = enough
        self.asked = 0
        self.has_enough = threading.Event()

    def machine(self) -> MachineLoad:
        return MachineLoad((50.0,), 1000, 10.0, 0, 0)

    def groups(self) -> dict[str, GroupLoad]:
        self.asked += 1
        if self.asked > self._enough:
            self.has_enough.set()
        return {"snn": GroupLoad(0.01 * self.asked, 2000, 3)}


def run(folder: Path, meter: Meter) -> LoadMonitor:
    monitor = LoadMonitor(folder, meter, LoadTable(["snn"], 1), PERIOD_S)
    monitor.start()
    return monitor


def test_every_period_has_a_row_and_the_file_ends_with_the_run(tmp_path: Path) -> None:
    meter = Meter(5)
    monitor = run(tmp_path, meter)
    assert meter.has_enough.wait(DEADLINE_S)
    summary = monitor.stop()
    with open(tmp_path / FILE_NAME, newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == summary["samples"] >= 5
    assert [row["snn.threads"] for row in rows] == ["3"] * len(rows)
    times = [float(row["time_s"]) for row in rows]
    assert times == sorted(times)
    assert monitor.failure is None


def test_rows_can_be_read_while_the_run_goes_on(tmp_path: Path) -> None:
    meter = Meter(3)
    monitor = run(tmp_path, meter)
    try:
        assert meter.has_enough.wait(DEADLINE_S)
        assert len((tmp_path / FILE_NAME).read_text().splitlines()) >= 3
    finally:
        monitor.stop()


def test_a_full_disk_is_told_at_the_end_and_ends_nothing_but_the_monitor(
    tmp_path: Path,
) -> None:
    (tmp_path / FILE_NAME).symlink_to("/dev/full")
    monitor = run(tmp_path, Meter(5))
    monitor.join(DEADLINE_S)
    assert not monitor.is_alive()
    monitor.stop()
    assert monitor.failure is not None
    assert "No space left on device" in monitor.failure
    assert FILE_NAME in monitor.failure
