"""Steps of a session in the process of its nodes: who waits for the next one."""

from __future__ import annotations

import selectors
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from containers import wait_until
from neuros.control import TO_SESSION, Advance, Message
from neuros.control.link import ControlLink, encode
from neuros.node.stepping import SessionSteps

STEP = Advance(1, 1, {})


class Listener:
    """Lets one session connect, over a pair of sockets."""

    def __init__(self) -> None:
        self._arrival, self._knock = socket.socketpair()
        self.ours, self._theirs = socket.socketpair()
        self._knock.sendall(b"!")

    def fileno(self) -> int:
        return self._arrival.fileno()

    def accept(self) -> socket.socket:
        return self._theirs

    def close(self) -> None:
        self._arrival.close()
        self._knock.close()


class Process:
    """A node process: the test is its control thread and its loop."""

    def __init__(self) -> None:
        listener: Any = Listener()
        self.steps = SessionSteps(listener, self._advance, self.post)
        self.session = ControlLink(listener.ours, TO_SESSION, "the nodes")
        self.selector = selectors.DefaultSelector()
        self.events: list[Callable[[], None]] = []
        self.done: list[Message] = []
        self.steps.listen(self.selector)
        self.hear()

    def _advance(self, step: Message) -> None:
        self.done.append(step)

    def post(self, event: Callable[[], None]) -> None:
        self.events.append(event)

    def hear(self) -> int:
        """What the control thread does with what is there; returns how much that is."""
        ready = self.selector.select(0.0)
        for key, _ in ready:
            key.data()
        return len(ready)


@pytest.fixture
def process() -> Iterator[Process]:
    made = Process()
    yield made
    made.session.close()
    made.selector.close()
    made.steps.close()


def test_the_loop_does_a_step_that_the_control_thread_has_heard_of(process: Process) -> None:
    process.session.send(STEP)
    assert process.hear() == 1
    assert process.events == [process.steps.take]
    process.steps.take()
    assert process.done == [STEP]


def test_while_the_loop_has_the_stream_the_control_thread_does_not_hear_of_steps(
    process: Process,
) -> None:
    process.session.send(STEP)
    process.hear()
    process.steps.take()
    process.session.send(STEP)
    assert process.hear() == 0
    process.steps.take()
    assert process.done == [STEP, STEP]


def test_if_no_step_comes_for_a_moment_the_control_thread_waits_again(process: Process) -> None:
    process.session.send(STEP)
    process.hear()
    process.steps.take()
    process.steps.take()  # waits in vain
    process.session.send(STEP)
    assert process.hear() == 1


def test_what_the_loop_has_to_do_ends_its_waiting(
    process: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros.node.stepping._LINGER_MS", 600_000)
    process.session.send(STEP)
    process.hear()
    process.steps.take()
    loop = threading.Thread(target=process.steps.take)
    loop.start()
    wait_until(lambda: process.steps._is_waiting)
    process.steps.wake()
    loop.join(60.0)
    assert not loop.is_alive()
    process.session.send(STEP)
    assert process.hear() == 1


def test_a_step_in_two_parts_is_done_once_it_is_whole(process: Process) -> None:
    frame = encode(STEP)
    process.session.stream.sendall(frame[:9])
    process.hear()
    process.steps.take()
    assert process.done == []
    process.session.stream.sendall(frame[9:])
    process.events.pop()()
    assert process.done == [STEP]
