"""The console shows what nodes write, complete, in colour, and harmless."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.backends.console import LogTail, NonBlockingWriter, clean, format_record, wants_colours


class Screen:
    """A tail of the logs of two nodes, and what it has shown."""

    def __init__(self, folder: Path, colours: bool = False) -> None:
        self.files = {"snn": folder / "snn.log", "robot": folder / "robot.log"}
        self.shown = ""
        self.tail = LogTail(self.files, self._write, colours)

    def _write(self, text: str) -> None:
        self.shown += text

    def log(self, name: str, text: bytes) -> None:
        with open(self.files[name], "ab") as file:
            file.write(text)

    def after(self, name: str, text: bytes) -> str:
        """What is shown when a node writes ``text`` and ends."""
        self.log(name, text)
        self.tail.drain()
        return self.shown


@pytest.fixture
def screen(tmp_path: Path) -> Screen:
    return Screen(tmp_path)


RECORD = b"[INFO] [1700000000.123456789] [snn]: spikes: 12\n"


def test_records_pass_as_they_are(screen: Screen) -> None:
    assert screen.after("snn", RECORD) == RECORD.decode()


def test_other_lines_get_the_name_of_the_node(screen: Screen) -> None:
    assert screen.after("snn", b"hello\n") == "[snn] hello\n"


def test_files_may_appear_later(screen: Screen) -> None:
    assert not screen.tail.poll()
    screen.log("robot", b"hello\n")
    assert screen.tail.poll()
    assert not screen.tail.poll()
    assert screen.shown == "[robot] hello\n"
    screen.tail.close()


@pytest.mark.parametrize(
    "make",
    [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)],
    ids=["pipe", "folder", "link"],
)
def test_what_is_no_file_holds_up_nothing(screen: Screen, make: Callable[[Path], None]) -> None:
    make(screen.files["robot"])
    assert screen.after("snn", b"hello\n") == "[snn] hello\n"


def test_records_of_all_nodes_are_shown_in_the_order_of_their_times(screen: Screen) -> None:
    def record(second: int, name: str, text: str) -> bytes:
        return f"[INFO] [{second}.000000000] [{name}]: {text}\n".encode()

    screen.log("snn", record(1, "snn", "one") + record(3, "snn", "three") + b"and more\n")
    screen.log("robot", record(2, "robot", "two") + record(4, "robot", "four"))
    screen.tail.poll()
    assert re.findall(r"one|two|three|more|four", screen.shown) == [
        "one",
        "two",
        "three",
        "more",
        "four",
    ]


def test_only_complete_lines_are_shown_before_the_end(screen: Screen) -> None:
    screen.log("snn", b"one\ntw")
    screen.tail.poll()
    assert screen.shown == "[snn] one\n"
    screen.log("snn", b"o\nthree")
    screen.tail.poll()
    assert screen.shown == "[snn] one\n[snn] two\n"
    screen.tail.drain()
    assert screen.shown == "[snn] one\n[snn] two\n[snn] three\n"


def test_a_character_that_is_written_in_two_parts_stays_whole(screen: Screen) -> None:
    first, second = "ü".encode()[:1], "ü".encode()[1:]
    screen.log("snn", first)
    screen.tail.poll()
    assert screen.after("snn", second + b"\n") == "[snn] ü\n"


def test_bytes_that_are_no_text_are_shown_as_numbers(screen: Screen) -> None:
    assert screen.after("snn", b"\xff!\n") == "[snn] \\xff!\n"


def test_what_is_too_much_to_be_shown_is_left_out_and_said_so(screen: Screen) -> None:
    line = b"x" * 99 + b"\n"
    shown = screen.after("snn", b"first\n" + line * 100_000 + b"last\n").splitlines()
    assert (shown[0], shown[-1]) == ("[snn] first", "[snn] last")
    (notice,) = [each for each in shown if "not shown" in each]
    assert notice == f"[snn] (10 MB are not shown here; all of it is in {screen.files['snn']})"
    assert {*shown} == {"[snn] first", f"[snn] {'x' * 99}", notice, "[snn] last"}


def test_an_endless_line_is_shown_in_pieces(screen: Screen) -> None:
    screen.log("snn", b"x" * 200_000)
    while screen.tail.poll():
        pass
    assert len(screen.shown) > 100_000, "before its end"
    screen.tail.drain()
    assert screen.shown.count("x") == 200_000


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        (b"\x1b[2Jwiped", "wiped"),
        (b"\x1b]0;title\x07text", "\\x1b]0;title\\x07text"),
        (b"\x1bcreset", "\\x1bcreset"),
        (b"half\x1b[", "half\\x1b["),
        (b"bell\x07", "bell\\x07"),
        (b"tab\tstays", "tab\tstays"),
        (b"10%\r20%\r30%\r", "30%"),
        (b"\x1b[31mred\x1b[0m", "red"),
        ("\u009b2J".encode(), "\\x9b2J"),
        (b"a\x00b", "a\\x00b"),
    ],
)
def test_terminal_controls_do_nothing(screen: Screen, written: bytes, shown: str) -> None:
    assert screen.after("snn", written + b"\n") == f"[snn] {shown}\n"


@settings(max_examples=200)
@given(st.text(alphabet=st.sampled_from("\x1b[]P0;m?Hc\\\x07\x9b\x90\r\t\x7fa")), st.booleans())
def test_no_text_whatsoever_reaches_the_terminal_as_a_control(text: str, colours: bool) -> None:
    left = clean(text, keep_colours=colours)
    if colours:
        left = re.sub(r"\x1b\[[0-9;:]*m", "", left)
    assert not re.search(r"[\x00-\x08\x0a-\x1f\x7f-\x9f]", left)


def test_each_node_has_a_colour_of_its_own(tmp_path: Path) -> None:
    screen = Screen(tmp_path, colours=True)
    screen.log("snn", b"a\n")
    screen.log("robot", b"b\n")
    screen.tail.drain()
    snn, robot = screen.shown.splitlines()
    assert re.fullmatch(r"\x1b\[\d+m\[snn\] a\x1b\[0m", snn)
    assert snn.partition("m")[0] != robot.partition("m")[0]


def test_records_have_the_colour_of_the_node_that_they_name(tmp_path: Path) -> None:
    screen = Screen(tmp_path, colours=True)
    screen.log("snn", RECORD)
    screen.log("robot", RECORD)
    screen.tail.drain()
    own, through_another = screen.shown.splitlines()
    assert own == through_another


def test_warnings_and_errors_stand_out(tmp_path: Path) -> None:
    screen = Screen(tmp_path, colours=True)
    shown = screen.after("snn", b"[ERROR] [1700000000.123456789] [snn]: no\n")
    assert shown.startswith("\x1b[31m[ERROR]\x1b[0m")
    assert re.sub(r"\x1b\[[0-9;]*m", "", shown) == "[ERROR] [1700000000.123456789] [snn]: no\n"


def test_records_that_ros_has_coloured_are_still_records(screen: Screen) -> None:
    text = b"\x1b[33m[WARN] [1700000000.123456789] [snn]: hm\x1b[0m\n"
    assert screen.after("snn", text) == "[WARN] [1700000000.123456789] [snn]: hm\n"


def test_the_launcher_writes_records_as_ros_does() -> None:
    record = format_record("INFO", "neuros", "hello", 1700000000_000000042)
    assert record == "[INFO] [1700000000.000000042] [neuros]: hello"
    assert re.match(
        r"\[WARN\] \[\d+\.\d{9}\] \[neuros\]: now", format_record("WARN", "neuros", "now")
    )


def test_the_layout_of_ros_is_respected() -> None:
    layout = "{severity}/{name}: {message} {unknown}{line_number}"
    assert format_record("INFO", "neuros", "{name}", 0, layout) == "INFO/neuros: {name} {unknown}"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("terminal", "environ", "expected"),
    [
        (True, {}, True),
        (False, {}, False),
        (True, {"NO_COLOR": "1"}, False),
        (True, {"NO_COLOR": ""}, True),
        (True, {"TERM": "dumb"}, False),
        (True, {"RCUTILS_COLORIZED_OUTPUT": "0"}, False),
        (False, {"RCUTILS_COLORIZED_OUTPUT": "1"}, True),
    ],
)
def test_colours_are_for_terminals_that_want_them(
    terminal: bool, environ: dict[str, str], expected: bool
) -> None:
    assert wants_colours(Terminal() if terminal else io.StringIO(), environ) is expected


def test_a_closed_tail_holds_no_files(screen: Screen) -> None:
    before = len(os.listdir("/proc/self/fd"))
    screen.after("snn", b"x\n")
    assert len(os.listdir("/proc/self/fd")) == before
    assert not screen.tail.poll()


# ------------------------------------------------------------------ slow readers

MUCH = "x" * 99 + "\n"


@dataclass
class Pipe:
    """A writer at one end of a pipe, and a reader that reads when it is told to."""

    writer: NonBlockingWriter
    stream: TextIO
    reader: int

    def read(self) -> str:
        return os.read(self.reader, 1 << 16).decode()

    def fill(self) -> int:
        """Write until the reader would have to read; returns how much."""
        count = 0
        while not self.writer.is_behind:
            self.writer.write(MUCH)
            count += len(MUCH)
        return count


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    reader, end = os.pipe()
    with open(end, "w", encoding="utf-8") as stream:
        yield Pipe(NonBlockingWriter(stream), stream, reader)
    with contextlib.suppress(OSError):  # some tests close it
        os.close(reader)


def never() -> bool:
    return False


def test_text_arrives_at_once(pipe: Pipe) -> None:
    pipe.writer.write("hello, wörld\n")
    assert pipe.read() == "hello, wörld\n"
    assert not pipe.writer.is_behind


def test_what_was_printed_before_stays_before(pipe: Pipe) -> None:
    print("first", file=pipe.stream)
    NonBlockingWriter(pipe.stream).write("second\n")
    assert pipe.read() == "first\nsecond\n"


def test_a_reader_that_does_not_read_holds_up_nobody_and_gets_all_in_the_end(pipe: Pipe) -> None:
    length = pipe.fill()
    start_s = time.monotonic()
    for _ in range(1000):
        pipe.writer.write(MUCH)
    assert time.monotonic() - start_s < 10.0
    got = 0
    while pipe.writer.is_behind:
        got += len(pipe.read())
        pipe.writer.flush()
    got += len(pipe.read())
    assert got == length + 1000 * len(MUCH)


def test_a_reader_that_has_gone_is_no_error(pipe: Pipe) -> None:
    os.close(pipe.reader)
    pipe.writer.write("nobody hears this\n")
    pipe.writer.finish(never)
    assert not pipe.writer.is_behind


def test_a_reader_that_goes_while_text_waits_is_no_error_either(pipe: Pipe) -> None:
    pipe.fill()
    os.close(pipe.reader)
    pipe.writer.finish(never)
    assert not pipe.writer.is_behind


def test_patience_with_a_reader_ends(pipe: Pipe) -> None:
    pipe.fill()
    pipe.writer.finish(never, patience_s=0.1)
    assert not pipe.writer.is_behind


def test_the_user_may_have_had_enough(pipe: Pipe) -> None:
    pipe.fill()
    pipe.writer.finish(lambda: True)
    pipe.writer.write("more\n")
    assert not pipe.writer.is_behind


def test_a_pipe_that_somebody_made_non_blocking_is_fine(pipe: Pipe) -> None:
    flags = fcntl.fcntl(pipe.stream.fileno(), fcntl.F_GETFL)
    fcntl.fcntl(pipe.stream.fileno(), fcntl.F_SETFL, flags | os.O_NONBLOCK)
    pipe.fill()
    pipe.read()
    pipe.writer.flush()


def test_a_full_disk_is_no_reason_to_lose_the_run() -> None:
    with open("/dev/full", "w") as full:
        writer = NonBlockingWriter(full)
        writer.write("hello\n")
        assert not writer.is_behind
        assert writer.failure is not None
        assert writer.failure.errno == errno.ENOSPC


def test_no_output_at_all_is_fine() -> None:
    writer = NonBlockingWriter(None)
    writer.write("hello\n")
    writer.finish(never)


def test_a_stream_without_a_file_is_written_to_directly() -> None:
    stream = io.StringIO()
    NonBlockingWriter(stream).write("hello\n")
    assert stream.getvalue() == "hello\n"


def test_characters_that_the_terminal_does_not_know_are_shown_as_numbers() -> None:
    reader, end = os.pipe()
    with open(end, "w", encoding="ascii") as stream:
        NonBlockingWriter(stream).write("wörld\n")
        assert os.read(reader, 100) == b"w\\xf6rld\n"
    os.close(reader)
