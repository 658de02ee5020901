"""Whatever happens to the launcher, nothing of its run is left behind."""

from __future__ import annotations

import json
import os
import re
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import wait_until
from processes import is_alive

from neuros.backends.domain import choose_domain
from neuros.backends.guardian import GuardedProcess, Guardian
from neuros.backends.guardian_program import Orders
from neuros.backends.node_command import process_environment, with_libraries
from neuros.backends.run_processes import RUN_ID
from neuros.distribution import python_command

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
from neuros.backends.guardian import Guardian
guardian = Guardian.start(sys.argv[1])
guardian.await_ready()
print(guardian.pid, flush=True)
guardian.remove_later(Path(sys.argv[2]))
environment = {**os.environ, "NEUROS_RUN_ID": sys.argv[1]}
for program in sys.argv[3:]:
    command = [sys.executable, "-S", "-c", program]
    host = guardian.spawn(command, Path("/dev/null"), Path("/"), environment)
    print(host.pid, flush=True)
print("started", flush=True)
time.sleep(60)
"""


STARTS_GUARDIANS_WHILE_CTRL_C_IS_HELD_DOWN = """
import os, signal, subprocess, sys
from neuros.backends.guardian import Guardian
signal.signal(signal.SIGINT, lambda *_: None)
keys = subprocess.Popen(["sh", "-c", "trap '' INT; while kill -INT 0; do :; done"])
try:
    for number in range(20):
        guardian = Guardian.start(sys.argv[1])
        guardian.await_ready()
        guardian.finish()
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
def guardian(run_id: str) -> Iterator[Guardian]:
    guardian = Guardian.start(run_id)
    guardian.await_ready()
    yield guardian
    guardian.finish()


def _processes_of(run_id: str) -> list[int]:
    mark, found = f"{RUN_ID}={run_id}".encode(), []
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            if mark in Path(f"/proc/{name}/environ").read_bytes().split(b"\0"):
                found.append(int(name))
        except OSError:
            continue
    return found


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
    wait_until(lambda: process.poll() is not None or run_id.encode() in environment.read_bytes())
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
        guardian, *hosts = [int(line) for line in iter(output.readline, "started\n")]
    sessions = set(hosts)
    # two hosts that stay, the double fork in its own session, the child with no environment
    wait_until(lambda: len(_processes_of(run_id)) == 3 and _has_orphan(sessions))
    orphans = [pid for pid in _all_pids() if _session(pid) in sessions]

    launcher.kill()
    launcher.wait(5)
    killed_at = time.monotonic()
    everything = [guardian, *hosts, *orphans]
    wait_until(lambda: not any(map(is_alive, everything)) and not _processes_of(run_id), within_s=6)
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
        if pid not in sessions and _session(pid) in sessions and is_alive(pid):
            command = Path(f"/proc/{pid}/cmdline").read_bytes()
            if b"time.sleep" in command and not Path(f"/proc/{pid}/environ").read_bytes():
                return True
    return False


def test_finish_kills_at_once_what_is_left(run_id: str, guardian: Guardian) -> None:
    process = _start(run_id, IGNORES_SIGTERM)
    guardian.finish()
    assert _end(process) == -signal.SIGKILL
    assert not guardian.is_on_duty


def test_a_launcher_may_go_on_while_its_guardian_kills_what_is_left(
    run_id: str, guardian: Guardian
) -> None:
    process = _start(run_id, IGNORES_SIGTERM)
    guardian.leave()
    assert _end(process) == -signal.SIGKILL
    guardian.finish()
    assert not guardian.is_on_duty


def test_processes_that_end_within_the_grace_period_are_not_killed(
    run_id: str, guardian: Guardian
) -> None:
    process = _start(run_id, "import time; time.sleep(0.3)")
    guardian.finish(grace_s=10)
    assert _end(process) == 0


def test_the_grace_period_ends_early_when_all_are_gone(guardian: Guardian) -> None:
    begin = time.monotonic()
    guardian.finish(grace_s=10)
    assert time.monotonic() - begin < 9


def test_what_the_program_of_the_launcher_has_lost_is_left_alone(
    guardian: Guardian, tmp_path: Path
) -> None:
    """It may be a program of the user: only what descends from a node belongs to the run."""
    mark = tmp_path / "pid"
    process = subprocess.Popen(["/bin/sh", "-c", f"sleep 60 & echo $! >{mark}"], env={})
    process.wait(10)
    stranger = int(mark.read_text())
    try:
        guardian.finish()
        assert is_alive(stranger)
    finally:
        os.kill(stranger, signal.SIGKILL)


def test_processes_of_other_runs_are_left_alone(run_id: str, guardian: Guardian) -> None:
    other = _start(f"{run_id}0", "import time; print(flush=True); time.sleep(60)")
    try:
        guardian.finish()
        assert other.poll() is None
    finally:
        other.kill()
        _end(other)


def test_a_guardian_ignores_the_signals_of_terminals_and_service_managers(
    run_id: str, guardian: Guardian
) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(guardian.pid, number)
    process = _start(run_id, IGNORES_SIGTERM)
    guardian.finish()
    assert _end(process) == -signal.SIGKILL


def test_ctrl_c_does_not_reach_a_guardian_that_is_just_being_started(run_id: str) -> None:
    subprocess.run(
        [sys.executable, "-c", STARTS_GUARDIANS_WHILE_CTRL_C_IS_HELD_DOWN, run_id],
        start_new_session=True,
        check=True,
        timeout=60,
    )


def test_the_launcher_does_the_work_of_a_guardian_that_was_killed(
    run_id: str, guardian: Guardian, tmp_path: Path
) -> None:
    left = tmp_path / "socket"
    left.touch()
    os.kill(guardian.pid, signal.SIGKILL)
    wait_until(lambda: not guardian.is_on_duty)
    guardian.remove_later(left)
    process = _start(run_id, IGNORES_SIGTERM)
    guardian.finish()
    assert _end(process) == -signal.SIGKILL
    assert not left.exists()


def test_files_are_removed_after_the_processes_whatever_their_names(
    guardian: Guardian, tmp_path: Path
) -> None:
    odd = tmp_path / os.fsdecode(b"a b\n\xff")
    odd.touch()
    link = tmp_path / "link"
    target = tmp_path / "target"
    target.mkdir()
    link.symlink_to(target)
    guardian.remove_later(odd)
    guardian.remove_later(link)
    guardian.remove_later(tmp_path / "never existed")
    guardian.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["target"]


def test_a_guardian_holds_the_domain_and_removes_the_lock_file(run_id: str, tmp_path: Path) -> None:
    lock = choose_domain(None, {}, False, folder=tmp_path)
    guardian = Guardian.start(run_id)
    guardian.hold(lock)
    guardian.await_ready()
    descriptor = lock.fileno()
    assert descriptor is not None
    os.close(descriptor)  # as if the launcher were dead
    lock._descriptor = None
    with choose_domain(None, {}, False, folder=tmp_path) as other:
        assert other.id != lock.id
    guardian.finish()
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------ forks

REPORT = """
import gc, json, os, random, signal, sys, threading
fields = dict(line.split(":", 1) for line in open("/proc/self/status") if ":" in line)
own = "/proc/self/fd/"
links = {n: os.readlink(own + n) for n in os.listdir(own) if os.path.exists(own + n)}
print(json.dumps({
    "command": open("/proc/self/cmdline").read().split("\\0"),
    "environment": sorted(open("/proc/self/environ").read().split("\\0")),
    "variables": dict(os.environ),
    "descriptors": {n: link for n, link in links.items() if "/proc/" not in link},
    "folder": os.getcwd(),
    "leads": [os.getsid(0) == os.getpid(), os.getpgid(0) == os.getpid()],
    "name": fields["Name"],
    "signals": [fields[name] for name in ("SigBlk", "SigIgn", "SigCgt")],
    "interrupt": str(signal.getsignal(signal.SIGINT)),
    "umask": fields["Umask"],
    "cores": sorted(os.sched_getaffinity(0)),
    "arguments": sys.argv,
    "path": sys.path,
    "main": sys.modules["__main__"].__file__,
    "threads": [thread.name for thread in threading.enumerate()],
    "collects": gc.isenabled(),
    "streams": [str(stream.encoding) + stream.errors for stream in (sys.stdout, sys.stderr)],
    "is_forked": "early" in sys.modules,
    "drawn": random.random(),
}))
"""
SPAWNS = """
import multiprocessing
if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        print(pool.apply(abs, [-3]))
"""
ROS = """
import rclpy
rclpy.init()
node = rclpy.create_node("forked")
print(node.get_name(), flush=True)
node.destroy_node()
rclpy.shutdown()
"""


class Forks:
    """Starts modules by a guardian that has imported ``early`` from the same folder."""

    def __init__(self, guardian: Guardian, folder: Path) -> None:
        self._guardian, self._folder = guardian, folder
        (folder / "early.py").write_text("")
        guardian.import_early(["early"], folders=[folder])
        python_path = {"PYTHONPATH": os.pathsep.join([str(folder), *_python_path()])}
        self._environment = with_libraries(process_environment(os.environ, python_path))

    def start(self, text: str, **variables: str) -> tuple[GuardedProcess, Path]:
        """Start a module with this text."""
        name = f"module_{secrets.token_hex(4)}"
        (self._folder / f"{name}.py").write_text(text)
        log = self._folder / f"{name}.log"
        environment = {**self._environment, **variables}
        command = python_command(name, "--flag", "two words")
        return self._guardian.spawn(command, log, self._folder, environment), log

    def run(self, text: str, **variables: str) -> str:
        """The output of such a module, which ends well."""
        process, log = self.start(text, **variables)
        process.wait(30.0)
        assert process.poll() == 0, log.read_text()
        return log.read_text()


def _python_path() -> list[str]:
    return [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]


@pytest.fixture
def forks(guardian: Guardian, tmp_path: Path) -> Forks:
    return Forks(guardian, tmp_path)


def test_a_fork_is_as_if_it_had_just_been_started(forks: Forks) -> None:
    forked, started = (
        json.loads(re.sub(r"module_[0-9a-f]+", "module", forks.run(REPORT, **variables)))
        for variables in ({"OWN": "1"}, {"TZ": "UTC", "OWN": "1"})
    )
    for report in (forked, started):
        report["variables"].pop("TZ", None)
        report["environment"] = [each for each in report["environment"] if each != "TZ=UTC"]
    assert (forked.pop("is_forked"), started.pop("is_forked")) == (True, False)
    assert forked.pop("drawn") != started.pop("drawn")
    assert forked == started


def test_two_forks_draw_different_numbers(guardian: Guardian, forks: Forks) -> None:
    guardian.import_early(["numpy.random"])
    draw = "import random, numpy.random; print(random.random(), numpy.random.rand())"
    first, second = forks.run(draw).split(), forks.run(draw).split()
    assert {*first}.isdisjoint(second)


@pytest.mark.parametrize(
    "variable",
    ["PYTHONHASHSEED", "LD_PRELOAD", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LC_ALL"],
)
def test_what_a_library_reads_when_it_is_loaded_is_there_before_it_is_loaded(
    variable: str, forks: Forks
) -> None:
    says = f"import sys, os; print('early' in sys.modules, os.environ[{variable!r}])"
    assert forks.run(says, **{variable: "7"}).splitlines()[-1] == "False 7"


def test_a_fork_may_start_processes_of_its_own(forks: Forks) -> None:
    assert forks.run(SPAWNS) == "3\n"


def test_a_fork_of_a_guardian_that_has_imported_ros_ends_well(
    guardian: Guardian, forks: Forks
) -> None:
    guardian.import_early(["neuros.cli.node", "load_transport", "ros"])
    assert forks.run(ROS, ROS_DOMAIN_ID="97") == "forked\n"


def test_how_a_fork_ends_is_how_its_program_ends(forks: Forks) -> None:
    ends = {
        "import sys; sys.exit(7)": 7,
        "raise ValueError": 1,
        "import os; os.kill(os.getpid(), 9)": -signal.SIGKILL,
        "import os, signal; os.kill(os.getpid(), signal.SIGTERM)": -signal.SIGTERM,
    }
    for text, code in ends.items():
        process, _ = forks.start(text)
        process.wait(30.0)
        assert process.poll() == code, text


def test_signals_reach_the_process_group_of_a_fork_at_once(forks: Forks) -> None:
    for _ in range(20):
        process, _ = forks.start("import time; time.sleep(60)")
        process.send_signal(signal.SIGKILL, is_for_group=True)
        process.wait(30.0)
        assert process.poll() == -signal.SIGKILL


def test_what_a_fork_has_left_ends_with_the_run(
    guardian: Guardian, forks: Forks, tmp_path: Path
) -> None:
    mark = tmp_path / "pid"
    daemon = f"open({str(mark)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    forks.run(f"import os, time\nif os.fork() == 0:\n  os.setsid(); os.environ.clear(); {daemon}")
    wait_until(lambda: mark.exists() and mark.read_text() != "")
    guardian.finish()
    assert not is_alive(int(mark.read_text()))


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_what_a_run_has_left_is_told_by_its_age_though_the_clock_was_set(
    step_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    before_s, orders = time.time(), Orders()
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + step_s)
    assert before_s + min(step_s, 0.0) - 0.1 <= orders.started_s <= before_s + min(step_s, 0.0) + 1
