"""The supervisor's ends of the control channel: they hear everything and wait for nobody."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neuros.control import Lines, connect
from neuros.launcher.channels import Channels


@pytest.fixture
def channels(tmp_path: Path) -> Iterator[Channels]:
    channels = Channels(tmp_path)
    yield channels
    channels.close()


@pytest.fixture
def node(channels: Channels, tmp_path: Path) -> Iterator[Lines]:
    lines = connect(tmp_path)
    yield lines
    lines.close()


def kinds(channels: Channels) -> list[Any]:
    return [message["kind"] for _, message in channels.receive()]


def test_what_was_said_before_hanging_up_is_heard_in_one_go(
    channels: Channels, node: Lines
) -> None:
    node.send("hello", nodes=["a"])
    node.send("failed", text="why")
    node.close()
    assert kinds(channels) == ["hello", "failed"]
    assert kinds(channels) == []


def test_several_hundred_kilobytes_are_one_go_too(channels: Channels, node: Lines) -> None:
    node.socket.setblocking(False)
    count = 0
    while node.send("report", text="x" * 1000):
        count += 1
    assert kinds(channels)[:count] == ["report"] * count


def test_half_a_line_waits_for_its_other_half(channels: Channels, node: Lines) -> None:
    node.socket.sendall(b'{"kind": "rep')
    assert kinds(channels) == []
    node.socket.sendall(b'ort"}\n')
    assert kinds(channels) == ["report"]


def test_whoever_does_not_keep_to_the_format_is_hung_up_on(channels: Channels, node: Lines) -> None:
    node.socket.sendall(b"GET / HTTP/1.1\r\n\r\n")
    assert kinds(channels) == []
    node.socket.settimeout(5.0)
    assert node.receive() is None


def test_all_are_told(channels: Channels, node: Lines, tmp_path: Path) -> None:
    other = connect(tmp_path)
    assert kinds(channels) == []
    channels.send("probe", number=3)
    for lines in (node, other):
        assert lines.receive() == [{"kind": "probe", "number": 3}]
    other.close()


def test_one_that_does_not_read_holds_up_nobody_and_misses_nothing(
    channels: Channels, node: Lines
) -> None:
    assert kinds(channels) == []
    node.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    start_s = time.monotonic()
    for number in range(5000):
        channels.send("probe", number=number)
    assert time.monotonic() - start_s < 10.0
    got: list[Any] = []
    node.socket.settimeout(5.0)
    while len(got) < 5000:
        got += node.receive() or []
        channels.flush()
    assert [message["number"] for message in got] == list(range(5000))


def test_one_that_has_gone_is_no_error(channels: Channels, node: Lines) -> None:
    assert kinds(channels) == []
    node.close()
    channels.send("stop")
    assert kinds(channels) == []
    channels.send("stop")


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
