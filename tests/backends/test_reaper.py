"""Whatever happens to the launcher, nothing of its run is left behind."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from neuros.backends.domain import choose_domain
from neuros.backends.reaper import Reaper
from neuros.backends.reaper_program import Orders
from neuros.backends.run_processes import RUN_ID

IGNORES_SIGTERM = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
time.sleep(60)
"""
HOLDS_THE_GIL = """
import ctypes
ctypes.PyDLL(None).sleep(60)
"""
DOUBLE_FORKS_INTO_A_NEW_SESSION = """
import os, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        time.sleep(60)
"""
STARTS_A_CHILD_WITH_AN_EMPTY_ENVIRONMENT = """
import os, sys
if os.fork() == 0:
    os.execve(sys.executable, [sys.executable, "-S", "-c", "import time; time.sleep(60)"], {})
"""
# Prints its own process id, so that the test can look for it.
HELLO = "import os; print(os.getpid(), flush=True)\n"

LAUNCHER = """
import os, subprocess, sys, time
from pathlib import Path
from neuros.backends.reaper import Reaper
from neuros.backends.reaper_program import Orders
from neuros.backends.node_command import process_environment
reaper = Reaper.start(sys.argv[1])
print(reaper.pid, flush=True)
reaper.remove_later(Path(sys.argv[2]))
environment = {**os.environ, "NEUROS_RUN_ID": sys.argv[1]}
for program in sys.argv[3:]:
    host = subprocess.Popen(
        [sys.executable, "-S", "-c", program], env=environment, start_new_session=True
    )
    reaper.watch(host.pid)
    print(host.pid, flush=True)
print("started", flush=True)
time.sleep(60)
"""


STARTS_REAPERS_WHILE_CTRL_C_IS_HELD_DOWN = """
import os, signal, subprocess, sys
from neuros.backends.reaper import Reaper
signal.signal(signal.SIGINT, lambda *_: None)
keys = subprocess.Popen(["sh", "-c", "trap '' INT; while kill -INT 0; do :; done"])
try:
    for number in range(20):
        Reaper.start(sys.argv[1]).finish()
finally:
    keys.kill()
"""


@pytest.fixture
def run_id() -> Iterator[str]:
    run_id = secrets.token_hex(8)
    yield run_id
    for pid in _processes_of(run_id):
        os.kill(pid, signal.SIGKILL)


@pytest.fixture
def reaper(run_id: str) -> Iterator[Reaper]:
    reaper = Reaper.start(run_id)
    yield reaper
    reaper.finish()


def _processes_of(run_id: str) -> list[int]:
    mark, found = f"{RUN_ID}={run_id}".encode(), []
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            if mark in Path(f"/proc/{name}/environ").read_bytes().split(b"\0"):
                found.append(int(name))
        except OSError:
            continue
    return found


def _is_alive(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return False
    return stat[stat.rindex(b")") + 2 :][:1] not in (b"Z", b"X")


def _wait_until(condition: Callable[[], bool], deadline_s: float = 10.0) -> None:
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, "deadline passed"
        time.sleep(0.01)


def _start(run_id: str, program: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", program],
        env={**os.environ, RUN_ID: run_id},
        start_new_session=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    # Popen returns before the kernel shows the environment, by which a process of a run is known.
    environment = Path(f"/proc/{process.pid}/environ")
    _wait_until(lambda: process.poll() is not None or run_id.encode() in environment.read_bytes())
    return process


def _end(process: subprocess.Popen[str]) -> int:
    code = process.wait(10)
    assert process.stdout is not None
    process.stdout.close()
    return code


def test_nothing_is_left_six_seconds_after_the_launcher_was_killed(
    run_id: str, tmp_path: Path
) -> None:
    left = tmp_path / "left"
    left.mkdir()
    (left / "control.socket").touch()
    programs = [
        IGNORES_SIGTERM,
        HOLDS_THE_GIL,
        DOUBLE_FORKS_INTO_A_NEW_SESSION,
        STARTS_A_CHILD_WITH_AN_EMPTY_ENVIRONMENT,
    ]
    launcher = subprocess.Popen(
        [sys.executable, "-c", LAUNCHER, run_id, str(left), *programs],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert launcher.stdout is not None
    with launcher.stdout as output:
        reaper, *hosts = [int(line) for line in iter(output.readline, "started\n")]
    sessions = set(hosts)
    # two hosts that stay, the double fork in its own session, the child with no environment
    _wait_until(lambda: len(_processes_of(run_id)) == 3 and _has_orphan(sessions))
    orphans = [pid for pid in _all_pids() if _session(pid) in sessions]

    launcher.kill()
    launcher.wait(5)
    killed_at = time.monotonic()
    everything = [reaper, *hosts, *orphans]
    _wait_until(
        lambda: not any(map(_is_alive, everything)) and not _processes_of(run_id), deadline_s=6
    )
    assert time.monotonic() - killed_at > 4, "the nodes had their time to finalise"
    assert not left.exists()


def _all_pids() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]


def _session(pid: int) -> int:
    try:
        return os.getsid(pid)
    except ProcessLookupError:
        return 0


def _has_orphan(sessions: set[int]) -> bool:
    """A process in the session of a host, with an empty environment."""
    for pid in _all_pids():
        if pid not in sessions and _session(pid) in sessions and _is_alive(pid):
            command = Path(f"/proc/{pid}/cmdline").read_bytes()
            if b"time.sleep" in command and not Path(f"/proc/{pid}/environ").read_bytes():
                return True
    return False


def test_finish_kills_at_once_what_is_left(run_id: str, reaper: Reaper) -> None:
    process = _start(run_id, IGNORES_SIGTERM)
    reaper.finish()
    assert _end(process) == -signal.SIGKILL
    assert not reaper.is_on_duty


def test_a_launcher_may_go_on_while_its_reaper_kills_what_is_left(
    run_id: str, reaper: Reaper
) -> None:
    process = _start(run_id, IGNORES_SIGTERM)
    reaper.leave()
    assert _end(process) == -signal.SIGKILL
    reaper.finish()
    assert not reaper.is_on_duty


def test_processes_that_end_within_the_grace_period_are_not_killed(
    run_id: str, reaper: Reaper
) -> None:
    process = _start(run_id, "import time; time.sleep(0.3)")
    reaper.finish(grace_s=10)
    assert _end(process) == 0


def test_the_grace_period_ends_early_when_all_are_gone(reaper: Reaper) -> None:
    begin = time.monotonic()
    reaper.finish(grace_s=10)
    assert time.monotonic() - begin < 9


def test_what_the_program_of_the_launcher_has_lost_is_left_alone(
    reaper: Reaper, tmp_path: Path
) -> None:
    """It may be a program of the user: only what descends from a node belongs to the run."""
    mark = tmp_path / "pid"
    process = subprocess.Popen(["/bin/sh", "-c", f"sleep 60 & echo $! >{mark}"], env={})
    process.wait(10)
    stranger = int(mark.read_text())
    try:
        reaper.finish()
        assert _is_alive(stranger)
    finally:
        os.kill(stranger, signal.SIGKILL)


def test_processes_of_other_runs_are_left_alone(run_id: str, reaper: Reaper) -> None:
    other = _start(f"{run_id}0", "import time; print(flush=True); time.sleep(60)")
    try:
        reaper.finish()
        assert other.poll() is None
    finally:
        other.kill()
        _end(other)


def test_a_reaper_ignores_the_signals_of_terminals_and_service_managers(
    run_id: str, reaper: Reaper
) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(reaper.pid, number)
    process = _start(run_id, IGNORES_SIGTERM)
    reaper.finish()
    assert _end(process) == -signal.SIGKILL


def test_ctrl_c_does_not_reach_a_reaper_that_is_just_being_started(run_id: str) -> None:
    subprocess.run(
        [sys.executable, "-c", STARTS_REAPERS_WHILE_CTRL_C_IS_HELD_DOWN, run_id],
        start_new_session=True,
        check=True,
        timeout=60,
    )


def test_the_launcher_does_the_work_of_a_reaper_that_was_killed(
    run_id: str, reaper: Reaper, tmp_path: Path
) -> None:
    left = tmp_path / "socket"
    left.touch()
    os.kill(reaper.pid, signal.SIGKILL)
    _wait_until(lambda: not reaper.is_on_duty)
    reaper.remove_later(left)
    process = _start(run_id, IGNORES_SIGTERM)
    reaper.finish()
    assert _end(process) == -signal.SIGKILL
    assert not left.exists()


def test_files_are_removed_after_the_processes_whatever_their_names(
    reaper: Reaper, tmp_path: Path
) -> None:
    odd = tmp_path / os.fsdecode(b"a b\n\xff")
    odd.touch()
    link = tmp_path / "link"
    target = tmp_path / "target"
    target.mkdir()
    link.symlink_to(target)
    reaper.remove_later(odd)
    reaper.remove_later(link)
    reaper.remove_later(tmp_path / "never existed")
    reaper.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["target"]


def test_a_reaper_holds_the_domain_and_removes_the_lock_file(run_id: str, tmp_path: Path) -> None:
    lock = choose_domain(None, {}, False, folder=tmp_path)
    reaper = Reaper.start(run_id, lock)
    descriptor = lock.fileno()
    assert descriptor is not None
    os.close(descriptor)  # as if the launcher were dead
    lock._descriptor = None
    with choose_domain(None, {}, False, folder=tmp_path) as other:
        assert other.id != lock.id
    reaper.finish()
    assert list(tmp_path.iterdir()) == []


def test_the_launcher_waits_for_no_import_that_only_removing_files_needs() -> None:
    root = str(Path(__file__).resolve().parents[2])
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import neuros.backends.reaper_program;"
        " print(*sorted({'dataclasses', 'pathlib', 'shutil', 'subprocess'} & {*sys.modules}))"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", program, root],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "\n"


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_what_a_run_has_left_is_told_by_its_age_though_the_clock_was_set(
    step_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    before_s, orders = time.time(), Orders()
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + step_s)
    assert before_s + min(step_s, 0.0) - 0.1 <= orders.started_s <= before_s + min(step_s, 0.0) + 1
