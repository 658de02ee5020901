"""Who watches a run, and may let it stand still."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from neuros.backends.control_sockets import UnixListener, connect
from neuros.control import (
    TO_NODES,
    TO_OBSERVERS,
    End,
    Ended,
    GetStatus,
    Hello,
    LogRecord,
    Message,
    NodeStatus,
    Pause,
    PhaseChanged,
    Resume,
    Step,
    Watch,
)
from neuros.control.link import ControlLink
from neuros.errors import ControlError
from neuros.launcher.channels import Channels, Observers, PauseState
from neuros.launcher.outcome import Outcome, Phase


class Run:
    """Observers of a run that is not there."""

    def __init__(self, folder: Path) -> None:
        self.now_s = 100.0
        listener = UnixListener(folder)
        self.address = listener.address
        self.channels = Channels(listener)
        self.pause = PauseState(self.channels.send, lambda: self.now_s)
        self.ends: list[str] = []
        self.is_driven = True
        self.observers = Observers(
            self.channels, self.pause, lambda: self.is_driven, self.ends.append
        )

    def join(self, *, is_node: bool = False) -> ControlLink:
        """Somebody connects."""
        stream = connect(self.address)
        assert isinstance(stream, socket.socket)
        stream.settimeout(5.0)
        return ControlLink(stream, TO_NODES if is_node else TO_OBSERVERS, "the supervisor")

    def hear(self, count: int = 1) -> None:
        """Take so many messages."""
        while count:
            self.channels.wait(5.0)
            for lines, message in self.channels.receive():
                assert not isinstance(message, ControlError)
                self.observers.receive(lines, message)
                count -= 1


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    made = Run(tmp_path)
    yield made
    made.channels.close()


def told(lines: ControlLink, count: int) -> list[Message]:
    found: list[Message] = []
    while len(found) < count:
        messages = lines.receive()
        assert messages is not None
        found += messages
    return found


def test_an_observer_is_told_the_phase_and_every_change_of_it(run: Run) -> None:
    lines = run.join()
    lines.send(Watch())
    run.hear()
    run.observers.update(Phase.RUNNING)
    run.observers.update(Phase.RUNNING)
    run.observers.update(Phase.DRAINING)
    run.observers.end(Outcome(3, "why"))
    assert told(lines, 3) == [
        PhaseChanged("running", False),
        PhaseChanged("draining", False),
        Ended(3, "why", {}, None, None),
    ]
    lines.close()


def test_what_nodes_show_goes_to_the_observer_that_asked(run: Run) -> None:
    node, first, second = run.join(is_node=True), run.join(), run.join()
    node.send(Hello(("a",)))
    run.hear()
    for observer in (first, second):
        observer.send(Watch())
        run.hear()
    for observer, wanted in ((first, {"a": {"x": {}}}), (second, {})):
        observer.send(GetStatus({"b": {}}))
        observer.send(GetStatus(wanted))  # takes the place of what was not asked yet
        run.hear(2)
    run.observers.update(Phase.RUNNING)
    looks = told(node, 2)
    assert looks == [GetStatus({"a": {"x": {}}}, 1), GetStatus({}, 2)]
    for look in looks:
        assert isinstance(look, GetStatus)
        samples = {port: dict(each) for port, each in look.wanted.get("a", {}).items()}
        node.send(NodeStatus("a", look.asker, samples=samples))
    run.hear(2)
    for observer, samples in ((first, {"x": {}}), (second, {})):
        run.observers.tell(LogRecord("INFO", "that is all"))
        _, *found = told(observer, 3)
        assert isinstance(found[0], NodeStatus)
        assert found[0].samples == samples
        assert found[1] == LogRecord("INFO", "that is all")
    for lines in (node, first, second):
        lines.close()


def test_pause_step_and_resume_reach_the_nodes_and_time_is_kept(run: Run) -> None:
    node, observer = run.join(is_node=True), run.join()
    node.send(Hello(("a",)))
    run.hear()
    observer.send(Watch())
    run.hear()
    for message in (
        Step(1),  # it is not paused: nothing happens
        Pause(),
        Pause(),
        Step(3),
        Step(-1),
    ):
        observer.send(message)
    run.hear(5)
    run.now_s += 7.0
    assert run.pause.is_on
    assert run.pause.total_s == 7.0
    observer.send(Resume())
    run.hear()
    run.now_s += 1.0
    assert not run.pause.is_on
    assert run.pause.total_s == 7.0
    assert told(node, 3) == [Pause(), Step(3, True), Resume()]
    node.close()
    observer.close()


def test_a_run_goes_on_when_nobody_is_left_to_resume_it(run: Run) -> None:
    observer = run.join()
    observer.send(Watch())
    observer.send(Pause())
    run.hear(2)
    run.observers.update(Phase.RUNNING)
    assert run.pause.is_on
    observer.close()
    while run.pause.is_on:
        run.channels.wait(5.0)
        assert list(run.channels.receive()) == []
        run.observers.update(Phase.RUNNING)


def test_the_end_of_a_run_ends_a_pause(run: Run) -> None:
    run.pause.begin()
    run.now_s += 2.0
    run.observers.update(Phase.DRAINING)
    run.now_s += 2.0
    assert (run.pause.is_on, run.pause.total_s) == (False, 2.0)


def test_an_observer_may_end_the_run(run: Run) -> None:
    observer = run.join()
    observer.send(Watch())
    observer.send(End("enough"))
    run.hear(2)
    assert run.ends == ["enough"]
    observer.close()
