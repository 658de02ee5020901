"""Who watches a run, and may let it stand still."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neuros.control import Lines, connect
from neuros.launcher.channels import Channels
from neuros.launcher.observers import Observers, Pause
from neuros.launcher.outcome import Outcome, Phase


class Run:
    """Observers of a run that is not there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now_s = 100.0
        self.channels = Channels(folder)
        self.pause = Pause(self.channels.send, lambda: self.now_s)
        self.ends: list[str] = []
        self.is_driven = True
        self.observers = Observers(
            self.channels, self.pause, lambda: self.is_driven, self.ends.append
        )

    def join(self) -> Lines:
        """Somebody connects."""
        lines = connect(self.folder)
        lines.socket.settimeout(5.0)
        return lines

    def hear(self, count: int = 1) -> None:
        """Take so many messages."""
        while count:
            self.channels.wait(5.0)
            for lines, message in self.channels.receive():
                self.observers.handlers[message["kind"]](lines, message)
                count -= 1


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    made = Run(tmp_path)
    yield made
    made.channels.close()


def told(lines: Lines, count: int) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    while len(found) < count:
        messages = lines.receive()
        assert messages is not None
        found += map(dict, messages)
    return found


def test_an_observer_is_told_the_phase_and_every_change_of_it(run: Run) -> None:
    lines = run.join()
    lines.send("watch")
    run.hear()
    run.observers.look_at(Phase.RUNNING)
    run.observers.look_at(Phase.RUNNING)
    run.observers.look_at(Phase.DRAINING)
    run.observers.part(Outcome(3, "why"))
    assert told(lines, 3) == [
        {"kind": "phase", "phase": "running", "is_paused": False},
        {"kind": "phase", "phase": "draining", "is_paused": False},
        {"kind": "ended", "exit_code": 3, "reason": "why", "reports": {}, "running_s": None},
    ]
    lines.close()


def test_what_nodes_show_goes_to_the_observer_that_asked(run: Run) -> None:
    node, first, second = run.join(), run.join(), run.join()
    for observer in (first, second):
        observer.send("watch")
        run.hear()
    for observer, wanted in ((first, {"a": {"x": {}}}), (second, {})):
        observer.send("look", wanted=wanted)
        run.hear()
    looks = told(node, 2)
    assert [look["wanted"] for look in looks] == [{"a": {"x": {}}}, {}]
    for look in looks:
        node.send("node_status", node="a", asker=look["asker"], samples=look["wanted"].get("a", {}))
    run.hear(2)
    for observer, samples in ((first, {"x": {}}), (second, {})):
        run.observers.tell("log", severity="INFO", text="that is all")
        found = [each for each in told(observer, 3) if each["kind"] in ("node_status", "log")]
        assert [each["kind"] for each in found[:2]] == ["node_status", "log"]
        assert found[0]["samples"] == samples
    for lines in (node, first, second):
        lines.close()


def test_pause_step_and_resume_reach_the_nodes_and_time_is_kept(run: Run) -> None:
    observer = run.join()
    for kind, fields in (
        ("step", {"count": 1}),  # it does not stand still: nothing happens
        ("pause", {}),
        ("pause", {}),
        ("step", {"count": 3}),
        ("step", {"count": -1}),
    ):
        observer.send(kind, **fields)
    run.hear(5)
    run.now_s += 7.0
    assert run.pause.is_on
    assert run.pause.total_s == 7.0
    observer.send("resume")
    run.hear()
    run.now_s += 1.0
    assert not run.pause.is_on
    assert run.pause.total_s == 7.0
    assert told(observer, 3) == [
        {"kind": "pause"},
        {"kind": "step", "count": 3, "is_driven": True},
        {"kind": "resume"},
    ]
    observer.close()


def test_a_run_goes_on_when_nobody_is_left_to_resume_it(run: Run) -> None:
    observer = run.join()
    observer.send("watch")
    observer.send("pause")
    run.hear(2)
    run.observers.look_at(Phase.RUNNING)
    assert run.pause.is_on
    observer.close()
    while run.pause.is_on:
        run.channels.wait(5.0)
        assert list(run.channels.receive()) == []
        run.observers.look_at(Phase.RUNNING)


def test_the_end_of_a_run_ends_a_pause(run: Run) -> None:
    run.pause.begin()
    run.now_s += 2.0
    run.observers.look_at(Phase.DRAINING)
    run.now_s += 2.0
    assert (run.pause.is_on, run.pause.total_s) == (False, 2.0)


def test_an_observer_may_end_the_run(run: Run) -> None:
    observer = run.join()
    observer.send("end", reason="enough")
    run.hear()
    assert run.ends == ["enough"]
    observer.close()
