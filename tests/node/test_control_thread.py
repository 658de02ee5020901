"""The thread of a node process that handles messages of the supervisor."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import pytest

from neuros.control import TO_NODES, Message, Pause, Probe, Ready
from neuros.control.link import ControlLink, encode
from neuros.errors import ControlError
from neuros.node.process import ControlThread


class Process:
    """Notes what it is asked for."""

    def __init__(self) -> None:
        self.handled: list[Message] = []
        self.events: list[Callable[[], None]] = []
        self.is_alone = False

    def handle(self, message: Message) -> None:
        self.handled.append(message)

    def post(self, event: Callable[[], None]) -> None:
        self.events.append(event)

    def on_supervisor_gone(self) -> None:
        self.is_alone = True


def run(sent: bytes) -> Any:
    """What becomes of these bytes, until the supervisor hangs up."""
    process: Any = Process()
    ours, theirs = socket.socketpair()
    signalled, signaller = socket.socketpair()
    with ours, signalled, signaller:
        with theirs:
            theirs.sendall(sent)
        link = ControlLink(ours, TO_NODES, "the supervisor")
        thread = ControlThread(link, signalled, process)
        thread.start()
        thread.join(10.0)
        assert not thread.is_alive()
    return process


def test_messages_are_handled_in_their_order_until_the_supervisor_hangs_up() -> None:
    process = run(encode(Pause()) + encode(Probe(3)))
    assert process.handled == [Pause(), Probe(3)]
    assert process.is_alone


def test_what_is_not_understood_fails_in_the_loop() -> None:
    process = run(encode(Ready("a")))
    (fail,) = process.events
    with pytest.raises(ControlError, match="the supervisor sent a wrong control message: I"):
        fail()
