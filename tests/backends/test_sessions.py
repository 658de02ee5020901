"""`neuros ps` and `neuros stop`: runs are seen by their marks."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from commands import neuros
from endings import KEEP_THE_GIL, RUNS
from launching import Running, start

from neuros.backends.sessions import RunOnThisMachine, mark, sessions, this_process

PLUGIN = f"from neuros.hooks import neuros_tick\n{RUNS}"
PROJECT = """
{"nodes": [{"name": "a", "container": "neuros_python", "plugin": "plugin.py"},
           {"name": "b", "container": "neuros_python", "plugin": "plugin.py"}],
 "connections": []}
"""


@pytest.fixture
def session() -> Iterator[RunOnThisMachine]:
    """A run of this process, that has a mark and nothing else."""
    session = RunOnThisMachine(
        *(secrets.token_hex(8), "demo", "process", ("a",), "/runs/1", time.time(), this_process())
    )
    lock = mark(session)
    yield session
    lock.release()
    assert session not in sessions()


@contextmanager
def marked(text: str, run: str = "") -> Iterator[Path]:
    """Any text in the place of the mark of a run, and a process that has it locked."""
    path = Path(f"/dev/shm/neuros_{run or secrets.token_hex(8)}_mark")
    path.write_text(text)
    with open(path) as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        yield path
    path.unlink()


def described(session: RunOnThisMachine, **others: object) -> dict[str, Any]:
    """What the mark of another such run says."""
    return {**asdict(session), "run": secrets.token_hex(8), **others}


def test_runs_of_other_versions_are_seen_if_they_say_enough(session: RunOnThisMachine) -> None:
    newer = described(session, colour="red")
    older = {"run": secrets.token_hex(8), "project": "demo"}
    with marked(json.dumps(newer)), marked(json.dumps(older)):
        runs = {each.run for each in sessions()}
    assert newer["run"] in runs
    assert older["run"] not in runs


@pytest.mark.parametrize(
    "written",
    ["", "{", "[]", "1", '{"run": 1}', "[" * 100_000, '{"nodes": {"a": 1}, "since": "now"}'],
)
def test_what_describes_no_run_is_passed_over(written: str, session: RunOnThisMachine) -> None:
    with marked(written):
        assert session in sessions()


def test_a_mark_that_nobody_has_locked_is_no_run(session: RunOnThisMachine) -> None:
    left = described(session)
    with marked(json.dumps(left)) as path:
        path.unlink()
        path.write_text(json.dumps(left))
        assert left["run"] not in {each.run for each in sessions()}


def test_names_do_nothing_to_a_terminal(session: RunOnThisMachine) -> None:
    forged = described(session, project="\x1b[2Jdemo\x07")
    with marked(json.dumps(forged)):
        names = {each.run: each.project for each in sessions()}
    assert names[forged["run"]] == "demo\\x07"


def test_a_run_is_its_marks_owners_whatever_that_says(session: RunOnThisMachine) -> None:
    forged = described(session, user=os.getuid() + 1)
    with marked(json.dumps(forged)):
        users = {each.run: each.user for each in sessions()}
    assert users[forged["run"]] == os.getuid()


def test_a_launcher_of_another_user_is_none(session: RunOnThisMachine) -> None:
    assert not replace(session, user=os.getuid() + 1).is_led


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo/plugin.py").write_text(PLUGIN)
    (tmp_path / "demo/project.json").write_text(PROJECT)
    return tmp_path


def run_of(running: Running) -> RunOnThisMachine:
    return next(each for each in sessions() if each.launcher[0] == running.process.pid)


def test_a_run_is_there_as_long_as_its_mark_is_locked(session: RunOnThisMachine) -> None:
    assert session in sessions()
    assert session.is_led
    assert session.states() == {"a": "not running"}


def test_another_process_with_the_number_of_the_launcher_is_not_the_launcher() -> None:
    stale = RunOnThisMachine("1", "demo", "process", (), "/runs/1", 0.0, (os.getpid(), 1))
    assert not stale.is_led
    stale.interrupt()  # and it does not interrupt this test


@pytest.mark.parametrize("back_end", ["process", "in-process"])
def test_ps_shows_the_nodes_and_stop_ends_them_as_ctrl_c_does(folder: Path, back_end: str) -> None:
    with start(folder / "demo", "--backend", back_end, cwd=folder) as running:
        running.wait_for("[b]: running", 30.0)
        run = run_of(running).run
        listed = neuros("ps")
        assert listed.returncode == 0, listed.stderr
        shown = [line.split() for line in listed.stdout.splitlines()]
        rows = [row for row in shown if row[0] == run[:8]]
        assert [(row[1], row[2], row[3], row[-1]) for row in rows] == [
            ("demo", "a", back_end, "running"),
            ("demo", "b", back_end, "running"),
        ], listed.stdout
        stopped = neuros("stop", run[:8])
        assert stopped.returncode == 0
        assert stopped.stdout.startswith(f"stopped {run[:8]} (demo); run folder {folder}")
        finished = running.finish(3.0)
    assert finished.exit_code == 130
    assert "ended by Ctrl+C" in finished.output


def test_a_run_whose_launcher_was_killed_is_ending_until_nothing_is_left(folder: Path) -> None:
    holding = PLUGIN.replace('"running")', f'"running")\n        {KEEP_THE_GIL}')
    (folder / "demo/plugin.py").write_text("import ctypes\n" + holding)
    with start(folder / "demo", "--backend", "process", cwd=folder) as running:
        for node in ("a", "b"):
            running.wait_for(f"[{node}]: running", 30.0)
        session = run_of(running)
        assert session.states() == {"a": "running", "b": "running"}
        running.signal(signal.SIGKILL)
        running.process.wait()
        assert session.states() == {"a": "ending", "b": "ending"}
        deadline_s = time.monotonic() + 15.0
        while session in sessions():
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
    assert set(session.states().values()) == {"not running"}


def test_a_run_that_is_not_there_is_wrong_usage(session: RunOnThisMachine) -> None:
    refused = neuros("stop", "nonsense")
    assert refused.returncode == 2
    assert refused.stderr.startswith("neuros: you have no run called 'nonsense'; yours are: ")
    assert f"{session.run[:8]} (demo)" in refused.stderr
