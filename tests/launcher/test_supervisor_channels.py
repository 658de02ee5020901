"""The supervisor's ends of the control channel: they hear everything and wait for nobody."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neuros.backends.control_sockets import UnixListener, connect
from neuros.control import (
    TO_NODES,
    TO_OBSERVERS,
    AtRest,
    Deliver,
    End,
    Ended,
    Failed,
    GetStatus,
    Hello,
    LogRecord,
    Probe,
    Progress,
    Ready,
    Stop,
    WasReset,
    Watch,
)
from neuros.control.link import ControlLink, encode
from neuros.errors import ControlError
from neuros.launcher.channels import Channels


class Node(ControlLink):
    """The end of a node."""

    def __init__(self, folder: Path) -> None:
        stream = connect(UnixListener(folder).address)
        assert isinstance(stream, socket.socket)
        self.socket = stream
        super().__init__(stream, TO_NODES, "the supervisor")


@pytest.fixture
def channels(tmp_path: Path) -> Iterator[Channels]:
    channels = Channels(UnixListener(tmp_path))
    yield channels
    channels.close()


@pytest.fixture
def node(channels: Channels, tmp_path: Path) -> Iterator[Node]:
    node = Node(tmp_path)
    yield node
    node.close()


def kinds(channels: Channels) -> list[Any]:
    return [
        "refused" if isinstance(message, ControlError) else type(message).__struct_config__.tag
        for _, message in channels.receive()
    ]


def received(channels: Channels, node: Node, until: Any) -> list[Any]:
    """What arrives there, up to a message, or within 5 s."""
    got: list[Any] = []
    node.socket.settimeout(0.1)
    deadline_s = time.monotonic() + 5.0
    while until not in got and time.monotonic() < deadline_s:
        got += node.receive() or []
        channels.flush()
    return got


def test_what_was_said_before_hanging_up_is_heard_in_one_go(channels: Channels, node: Node) -> None:
    node.send(Hello(("a",)))
    node.send(Failed("a", "why"))
    node.close()
    assert kinds(channels) == ["hello", "failed"]
    assert kinds(channels) == []


def test_several_hundred_kilobytes_are_one_go_too(channels: Channels, node: Node) -> None:
    node.socket.setblocking(False)
    node.send(Hello(("a",)))
    count = 0
    while node.send(Progress("a", "x" * 1000)):
        count += 1
    assert kinds(channels)[1 : count + 1] == ["progress"] * count


def test_half_a_message_waits_for_its_other_half(channels: Channels, node: Node) -> None:
    data = encode(Watch())
    node.socket.sendall(data[:7])
    assert kinds(channels) == []
    node.socket.sendall(data[7:])
    assert kinds(channels) == ["watch"]


def test_what_is_not_understood_comes_as_an_error_that_names_its_sender(
    channels: Channels, node: Node
) -> None:
    node.send(Ready("a"))
    node.send(Hello(("a", "b")))
    node.send(Watch())
    (link, stranger), _, (_, known) = channels.receive()
    assert str(stranger).startswith("an unknown program sent a wrong control message: Invalid")
    assert str(known).startswith("the process of a and b sent a wrong control message: Invalid")
    channels.hang_up(link)
    node.socket.settimeout(5.0)
    assert node.receive() is None


def test_all_nodes_are_told(channels: Channels, node: Node, tmp_path: Path) -> None:
    other, observer = Node(tmp_path), Node(tmp_path)
    for lines in (node, other):
        lines.send(Hello(("a",)))
    observer.send(Watch())
    assert sorted(kinds(channels)) == ["hello", "hello", "watch"]
    channels.send(Probe(3))
    for lines in (node, other):
        assert lines.receive() == [Probe(3)]
    observer.socket.setblocking(False)
    assert observer.receive() == [], "it is no node"
    other.close()
    observer.close()


def test_one_that_does_not_read_holds_up_nobody_and_misses_nothing(
    channels: Channels, node: Node
) -> None:
    node.send(Hello(("a",)))
    assert kinds(channels) == ["hello"]
    node.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    start_s = time.monotonic()
    for number in range(5000):
        channels.send(Probe(number))
    assert time.monotonic() - start_s < 10.0
    got: list[Any] = []
    node.socket.settimeout(5.0)
    while len(got) < 5000:
        got += node.receive() or []
        channels.flush()
    assert got == [Probe(number) for number in range(5000)]


def test_one_that_has_gone_is_no_error(channels: Channels, node: Node) -> None:
    node.send(Hello(("a",)))
    assert kinds(channels) == ["hello"]
    node.close()
    channels.send(Stop())
    assert kinds(channels) == []
    channels.send(Stop())


def test_a_signal_ends_the_wait(channels: Channels) -> None:
    reader, writer = socket.socketpair()
    with reader, writer:
        channels.wake_on(reader)
        writer.send(b"\x11\x11")
        channels.wait(60.0)
        writer.send(b"\x11")
        channels.wait(60.0)
        with pytest.raises(BlockingIOError):
            reader.recv(1)  # or it would never wait again


def test_other_programs_are_heard_in_turns_and_nodes_in_full(
    channels: Channels, node: Node, tmp_path: Path
) -> None:
    node.send(Hello(("a",)))
    assert kinds(channels) == ["hello"]
    flood = Node(tmp_path)
    flood.send(Watch())
    flood.socket.setblocking(False)
    while flood.send(GetStatus({})):
        pass
    node.socket.setblocking(False)
    count = 0
    while node.send(Progress("a", "x" * 1000)):
        count += 1
    heard = kinds(channels)
    assert heard.count("progress") >= count
    assert heard.count("get_status") < 5000
    flood.close()


def test_only_hello_and_watch_are_greetings_and_each_says_what_may_follow(
    channels: Channels, node: Node, tmp_path: Path
) -> None:
    observer = Node(tmp_path)
    for each, greeting in ((node, Hello(("a",))), (observer, Watch())):
        for message in (End("enough"), Failed("a", "why"), greeting):
            each.send(message)
        each.send(End("enough"))
        each.send(Failed("a", "why"))
        heard = [kind for _ in range(2) for kind in kinds(channels)]
        allowed = ["refused", "failed"] if each is node else ["end", "refused"]
        assert heard == ["refused", "refused", type(greeting).__struct_config__.tag, *allowed]
    observer.close()


def test_the_end_of_a_run_reaches_a_node_to_which_much_is_to_be_sent(
    channels: Channels, node: Node
) -> None:
    node.send(Hello(("a",)))
    assert kinds(channels) == ["hello"]
    for _ in range(300):
        channels.send(GetStatus({"a": {"x" * 10_000: {}}}, 1))
    channels.send(Stop())
    got = received(channels, node, until=Stop())
    assert got[-1] == Stop()
    assert len(got) < 300, "what observers want is left out"


def test_what_a_session_sends_reaches_a_node_to_which_much_is_to_be_sent(
    channels: Channels, node: Node
) -> None:
    node.send(Hello(("a",)))
    assert kinds(channels) == ["hello"]
    packets = [Deliver("a", "image", bytes([number]) * 2_000_000) for number in range(3)]
    for packet in packets:
        channels.send_to_node("a", packet)
    assert received(channels, node, until=packets[-1]) == packets


def test_an_observer_that_reads_late_misses_records_and_not_what_it_waits_for(
    channels: Channels, tmp_path: Path
) -> None:
    observer = Node(tmp_path)
    observer.accept(TO_OBSERVERS)
    observer.send(Watch())
    ((link, _),) = channels.receive()
    for _ in range(300):
        channels.send_to(link, LogRecord("INFO", "x" * 10_000))
    answers = [AtRest(1, {}, {}), WasReset(""), Ended(0, "done", {}, 1.0, None, True)]
    for answer in answers:
        channels.send_to(link, answer)
    got = received(channels, observer, until=answers[-1])
    assert got[-3:] == answers
    assert 0 < len(got) - 3 < 300
    observer.close()
