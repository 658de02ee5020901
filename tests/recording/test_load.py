"""Load of real processes, told apart by node; the load now; the thread that writes rows."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import psutil
import pytest

from neuros.recording import system_load
from neuros.recording.system_load import (
    FILE_NAME,
    LAUNCHER,
    GroupLoad,
    LoadMeter,
    LoadMonitor,
    LoadTable,
    MachineLoad,
)

DEADLINE_S = 20.0
MARK = "NEUROS_TEST_GROUP"

Start = Callable[..., psutil.Popen]


def owner(environment: Mapping[str, str]) -> str | None:
    return environment.get(MARK)


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts Python programs, marked with a group or not, and ends them with all their children."""
    started: list[psutil.Popen] = []

    def start_program(program: str, group: str | None) -> psutil.Popen:
        environment = {key: value for key, value in os.environ.items() if key != MARK}
        if group is not None:
            environment[MARK] = group
        process = psutil.Popen(
            [sys.executable, "-I", "-S", "-c", program],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        started.append(process)
        return process

    yield start_program
    for process in started:
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in [*process.children(recursive=True), process]:
                child.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def load_of(meter: LoadMeter, group: str, is_enough: Callable[[GroupLoad], bool]) -> GroupLoad:
    """The load of a group, as soon as it is what was waited for."""
    deadline_s = time.monotonic() + DEADLINE_S
    found = None
    while time.monotonic() < deadline_s:
        found = meter.groups().get(group)
        if found is not None and is_enough(found):
            return found
    raise AssertionError(f"not in {DEADLINE_S:g} s: {found}")


SPIN = "while True: pass"
REST = "input()"


def test_a_process_is_found_by_its_environment(start: Start) -> None:
    meter = LoadMeter(owner)
    start(REST, "snn")
    load = load_of(meter, "snn", lambda load: load.memory_bytes > 1_000_000)
    assert load.threads == 1


def test_a_process_that_was_there_before_the_first_look_is_found(start: Start) -> None:
    start(REST, "snn")
    load_of(LoadMeter(owner), "snn", lambda load: load.threads == 1)


def test_processor_time_goes_to_who_spends_it(start: Start) -> None:
    meter = LoadMeter(owner)
    start(SPIN, "busy")
    start(REST, "resting")
    load_of(meter, "busy", lambda load: load.cpu_s > 0.5)
    assert meter.groups()["resting"].cpu_s < 0.4


def test_children_belong_to_the_node_that_started_them(start: Start) -> None:
    program = (
        "import subprocess, sys\n"
        f"[subprocess.Popen([sys.executable, '-I', '-S', '-c', {REST!r}], env=environment,\n"
        "   stdin=subprocess.PIPE) for environment in (None, {})]\n"
        "input()"
    )
    meter = LoadMeter(owner)
    start(program, "snn")
    assert load_of(meter, "snn", lambda load: load.threads == 3).threads == 3


def test_the_time_of_a_child_that_has_ended_stays_with_its_node(start: Start) -> None:
    spin = "import time; end = time.process_time() + 0.4\nwhile time.process_time() < end: pass"
    program = (
        "import subprocess, sys\n"
        f"subprocess.run([sys.executable, '-I', '-S', '-c', {spin!r}])\n"
        "print('done', flush=True); input()"
    )
    meter = LoadMeter(owner)
    process = start(program, "snn")
    assert process.stdout.readline() == b"done\n"
    assert meter.groups()["snn"].cpu_s >= 0.39


def test_a_node_that_has_ended_is_not_counted_to_the_guardian_that_collects_it(
    start: Start,
) -> None:
    spin = "import time\nwhile time.process_time() < 0.4: pass"
    guardian = (
        "import subprocess, sys\n"
        f"subprocess.run([sys.executable, '-I', '-S', '-c', {spin!r}], env={{'{MARK}': 'snn'}})\n"
        "print('done', flush=True); input()"
    )
    meter = LoadMeter(owner)
    before_s = meter.groups()[LAUNCHER].cpu_s
    process = start(guardian, None)
    assert process.stdout.readline() == b"done\n"
    load = load_of(meter, LAUNCHER, lambda load: load.threads > threading.active_count())
    assert load.cpu_s - before_s < 0.3


def test_a_process_that_ends_leaves_its_group(start: Start) -> None:
    meter = LoadMeter(owner)
    process = start(REST, "snn")
    load_of(meter, "snn", lambda load: load.threads == 1)
    process.kill()
    process.wait()
    assert "snn" not in meter.groups()


def test_a_process_that_nobody_has_waited_for_yet_has_no_figures(start: Start) -> None:
    meter = LoadMeter(owner)
    process = start(REST, "snn")
    load_of(meter, "snn", lambda load: load.threads == 1)
    os.kill(process.pid, signal.SIGKILL)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert "snn" not in meter.groups()


def test_what_does_not_belong_to_the_run_is_in_no_group(start: Start) -> None:
    stranger = "import subprocess, sys; print('there', flush=True); input()"
    meter = LoadMeter(lambda environment: None)
    process = start(stranger, None)
    assert process.stdout.readline() == b"there\n"
    groups = meter.groups()
    assert set(groups) == {LAUNCHER}


def test_the_machine_has_a_figure_for_every_core() -> None:
    load = LoadMeter(owner).machine()
    assert len(load.core_percent) == psutil.cpu_count()
    assert 0 < load.memory_percent < 100
    assert load.memory_used_bytes > 0


PERIOD_S = 0.005


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(system_load, "open_new", lambda _: io.FileIO("/dev/full", "wb"))
    monitor = run(tmp_path, Meter(5))
    monitor.join(DEADLINE_S)
    assert not monitor.is_alive()
    monitor.stop()
    assert monitor.failure is not None
    assert "No space left on device" in monitor.failure
    assert FILE_NAME in monitor.failure
