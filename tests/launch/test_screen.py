"""Writing for readers who read slowly, not at all, or have gone."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TextIO

import pytest

from neuros.launch.screen import Screen

MUCH = "x" * 99 + "\n"


@dataclass
class Pipe:
    """A screen at one end of a pipe, and a reader that reads when it is told to."""

    screen: Screen
    stream: TextIO
    reader: int

    def read(self) -> str:
        return os.read(self.reader, 1 << 16).decode()

    def fill(self) -> int:
        """Write until the reader would have to read; returns how much."""
        count = 0
        while not self.screen.is_behind:
            self.screen.write(MUCH)
            count += len(MUCH)
        return count


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    reader, writer = os.pipe()
    with open(writer, "w", encoding="utf-8") as stream:
        yield Pipe(Screen(stream), stream, reader)
    with contextlib.suppress(OSError):  # some tests close it
        os.close(reader)


def never() -> bool:
    return False


def test_text_arrives_at_once(pipe: Pipe) -> None:
    pipe.screen.write("hello, wörld\n")
    assert pipe.read() == "hello, wörld\n"
    assert not pipe.screen.is_behind


def test_what_was_printed_before_stays_before(pipe: Pipe) -> None:
    print("first", file=pipe.stream)
    Screen(pipe.stream).write("second\n")
    assert pipe.read() == "first\nsecond\n"


def test_a_reader_that_does_not_read_holds_up_nobody_and_gets_all_in_the_end(pipe: Pipe) -> None:
    length = pipe.fill()
    start_s = time.monotonic()
    for _ in range(1000):
        pipe.screen.write(MUCH)
    assert time.monotonic() - start_s < 1.0
    got = 0
    while pipe.screen.is_behind:
        got += len(pipe.read())
        pipe.screen.flush()
    got += len(pipe.read())
    assert got == length + 1000 * len(MUCH)


def test_a_reader_that_has_gone_is_no_error(pipe: Pipe) -> None:
    os.close(pipe.reader)
    pipe.screen.write("nobody hears this\n")
    pipe.screen.finish(never)
    assert not pipe.screen.is_behind


def test_a_reader_that_goes_while_text_waits_is_no_error_either(pipe: Pipe) -> None:
    pipe.fill()
    os.close(pipe.reader)
    pipe.screen.finish(never)
    assert not pipe.screen.is_behind


def test_patience_with_a_reader_ends(pipe: Pipe) -> None:
    pipe.fill()
    pipe.screen.finish(never, patience_s=0.1)
    assert not pipe.screen.is_behind


def test_the_user_may_have_had_enough(pipe: Pipe) -> None:
    pipe.fill()
    pipe.screen.finish(lambda: True)
    pipe.screen.write("more\n")
    assert not pipe.screen.is_behind


def test_a_pipe_that_somebody_made_non_blocking_is_fine(pipe: Pipe) -> None:
    flags = fcntl.fcntl(pipe.stream.fileno(), fcntl.F_GETFL)
    fcntl.fcntl(pipe.stream.fileno(), fcntl.F_SETFL, flags | os.O_NONBLOCK)
    pipe.fill()
    pipe.read()
    pipe.screen.flush()


def test_a_full_disk_is_no_reason_to_lose_the_run() -> None:
    with open("/dev/full", "w") as full:
        screen = Screen(full)
        screen.write("hello\n")
        assert not screen.is_behind


def test_no_output_at_all_is_fine() -> None:
    screen = Screen(None)
    screen.write("hello\n")
    screen.finish(never)


def test_a_stream_without_a_file_is_written_to_directly() -> None:
    stream = io.StringIO()
    Screen(stream).write("hello\n")
    assert stream.getvalue() == "hello\n"


def test_characters_that_the_terminal_does_not_know_are_shown_as_numbers() -> None:
    reader, writer = os.pipe()
    with open(writer, "w", encoding="ascii") as stream:
        Screen(stream).write("wörld\n")
        assert os.read(reader, 100) == b"w\\xf6rld\n"
    os.close(reader)
