"""Console output of a run: lines that nodes log, a writer that never waits, and progress.

Nodes write their own log files; the launcher only reads along. So a slow terminal never holds up
a node, and the logs are complete even if the launcher is killed.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import select
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol, TextIO

from neuros.control import Report

LAYOUT = "[{severity}] [{time}] [{name}]: {message}"
"""What ROS 2 prints unless ``RCUTILS_CONSOLE_OUTPUT_FORMAT`` says otherwise."""

_RECORD = re.compile(r"\[(?P<severity>[A-Z]+)\] \[\d+\.\d{9}\] \[(?P<name>[^\]\s]+)\]: ?")
_TIME = re.compile(rb"\[[A-Z]+\] \[(\d+)\.(\d{9})\] \[")
_TOKEN = re.compile(r"\{(\w+)\}")
_RESET = "\x1b[0m"
_NODE_COLOURS = ("36", "32", "35", "34", "96", "92", "95", "94")
_SEVERITY_COLOURS = {"DEBUG": "2", "WARN": "33", "ERROR": "31", "FATAL": "1;31"}

# Colours, then all other control sequences of ECMA-48, then control characters.
_CONTROL = re.compile(
    r"(?P<colour>\x1b\[[0-9;:]*m)|(?P<sequence>\x1b\[[0-?]*[ -/]*[@-~])"
    r"|[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029]"
)
_READ_BYTES = 1 << 16
_LONGEST_LINE_BYTES = 1 << 16
_MOST_BEHIND_BYTES = 1 << 22
# A pipe that is ready takes this much without blocking (PIPE_BUF, pipe(7)).
_READER_IS_GONE = (errno.EPIPE, errno.EIO)  # of a pipe, of a terminal
_CHUNK_BYTES = 4096
_POLL_MS = 50
_WINDOW_S = 5.0
"""Rates are those of the last few reports, not of the whole run."""
_BESIDE_TEXT = 18
"""Columns: the percentage, and a bar that can be seen."""


class LogTail:
    """Shows complete lines of several growing files, each in a colour of its own.

    New lines of all files are shown in the order of their records' times; a line without a time
    stays behind the record before it. If a file grows faster than it can be shown, a part is left
    out, and a line tells that.

    Args:
        files: the file of each name, usually a node's; it need not exist yet.
        write: receives text of whole lines, with the line feed.
        colours: whether to colour; if not, the nodes' own colours are removed, too.
        last_bytes: how many bytes of the present content to show; ``None``: all.
    """

    def __init__(
        self,
        files: Mapping[str, Path],
        write: Callable[[str], None],
        colours: bool,
        last_bytes: int | None = None,
    ) -> None:
        palette = {
            name: _NODE_COLOURS[index % len(_NODE_COLOURS)] for index, name in enumerate(files)
        }
        self._palette = palette if colours else {}
        self._files = [_GrowingFile(name, path, last_bytes) for name, path in files.items()]
        self._write = write

    def poll(self) -> bool:
        """Show new lines, at most 64 KiB per file; returns whether a file has grown."""
        self._show([(file, file.read_lines()) for file in self._files])
        return any(file.has_grown for file in self._files)

    def drain(self) -> None:
        """Show the rest, with incomplete last lines, and close the files."""
        while self.poll():
            pass
        self._show([(file, file.last_line()) for file in self._files])
        self.close()

    def close(self) -> None:
        """Close the files; a second call has no effect."""
        for file in self._files:
            file.close()

    def __enter__(self) -> LogTail:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _show(self, found: list[tuple[_GrowingFile, list[bytes]]]) -> None:
        timed = [
            (file.time_of(line), f"{self._paint(file.name, line)}\n")
            for file, lines in found
            for line in lines
        ]
        if timed:
            timed.sort(key=lambda pair: pair[0])
            self._write("".join(text for _, text in timed))

    def _paint(self, name: str, line: bytes) -> str:
        """The line of a log as it appears on the console."""
        text = clean(line.decode("utf-8", "backslashreplace"), keep_colours=bool(self._palette))
        record = _RECORD.search(text) if "] [" in text else None
        if record is None or _CONTROL.sub("", text[: record.start()]):
            return self._coloured(name, f"[{name}] {text}")
        # A process may write records of any of its nodes.
        owner = record["name"] if record["name"] in self._palette else name
        mark = _SEVERITY_COLOURS.get(record["severity"])
        if not self._palette or not mark:
            return self._coloured(owner, text)
        head = f"[{record['severity']}]"
        rest = text[record.start() + len(head) :]
        return f"\x1b[{mark}m{head}{_RESET}{self._coloured(owner, rest)}"

    def _coloured(self, name: str, text: str) -> str:
        colour = self._palette.get(name)
        return f"\x1b[{colour}m{text}{_RESET}" if colour else text


def format_record(
    severity: str, name: str, text: str, time_ns: int | None = None, layout: str = LAYOUT
) -> str:
    """One log record as ROS 2 prints it, without the line feed.

    ``time_ns`` is Unix time, now if ``None``. ``layout`` is a value of
    ``RCUTILS_CONSOLE_OUTPUT_FORMAT``; its fields for source code (file, line) stay empty.
    """
    at_ns = time.time_ns() if time_ns is None else time_ns
    values = {
        "severity": severity,
        "name": name,
        "message": text,
        "time": f"{at_ns // 1_000_000_000}.{at_ns % 1_000_000_000:09d}",
        "time_as_nanoseconds": str(at_ns),
        "function_name": "",
        "file_name": "",
        "line_number": "",
    }
    return _TOKEN.sub(lambda match: values.get(match[1], match[0]), layout)


def wants_colours(stream: TextIO, environ: Mapping[str, str]) -> bool:
    """Whether to colour text for ``stream``.

    ``RCUTILS_COLORIZED_OUTPUT`` (0 or 1) decides, else ``NO_COLOR`` (https://no-color.org), else
    whether it is a terminal with colours.
    """
    told = environ.get("RCUTILS_COLORIZED_OUTPUT")
    if told in ("0", "1"):
        return told == "1"
    if environ.get("NO_COLOR"):
        return False
    return stream.isatty() and environ.get("TERM") != "dumb"


class _GrowingFile:
    def __init__(self, name: str, path: Path, last_bytes: int | None) -> None:
        self.name = name
        self.has_grown = False
        self._path = path
        self._last_bytes = last_bytes
        self._descriptor: int | None = None
        self._rest = b""
        self._last_time_ns = 0
        self._is_closed = False

    def time_of(self, line: bytes) -> int:
        """Unix time of a line in ns, never before that of the lines above it in the file."""
        record = _TIME.search(line)
        if record:
            time_ns = int(record[1]) * 1_000_000_000 + int(record[2])
            self._last_time_ns = max(self._last_time_ns, time_ns)
        return self._last_time_ns

    def read_lines(self) -> list[bytes]:
        """New complete lines, without line feeds."""
        data = b""
        if not self._is_closed:
            with contextlib.suppress(OSError):  # it is not there yet, or no file
                if self._descriptor is None:
                    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW
                    self._descriptor = os.open(self._path, flags)
                    if self._last_bytes is not None:
                        size = os.fstat(self._descriptor).st_size
                        os.lseek(self._descriptor, max(0, size - self._last_bytes), os.SEEK_SET)
                data = os.read(self._descriptor, _READ_BYTES)
        self.has_grown = bool(data)
        if not data:
            return []
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(data) == _READ_BYTES:
            lines += self._skip()
        while len(self._rest) > _LONGEST_LINE_BYTES:  # show it before its end
            lines.append(self._rest[:_LONGEST_LINE_BYTES])
            self._rest = self._rest[_LONGEST_LINE_BYTES:]
        return lines

    def _skip(self) -> list[bytes]:
        """Skip to the last 64 KiB of a file that is far ahead; returns a line about that."""
        assert self._descriptor is not None
        at, size = os.lseek(self._descriptor, 0, os.SEEK_CUR), os.fstat(self._descriptor).st_size
        if size - at <= _MOST_BEHIND_BYTES:
            return []
        os.lseek(self._descriptor, size - _READ_BYTES, os.SEEK_SET)
        _, _, shown = os.read(self._descriptor, _READ_BYTES).partition(b"\n")
        os.lseek(self._descriptor, -len(shown), os.SEEK_CUR)
        self._rest = b""
        left_out = (size - at - len(shown)) / 1e6
        return [f"({left_out:.0f} MB are not shown here; all of it is in {self._path})".encode()]

    def last_line(self) -> list[bytes]:
        rest, self._rest = self._rest, b""
        return [rest] if rest else []

    def close(self) -> None:
        self._is_closed = True
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def clean(text: str, *, keep_colours: bool) -> str:
    r"""One line without effect on a terminal.

    Control sequences are removed, except colours with ``keep_colours``; other control characters
    become text, as ``\x07``. Of a line overwritten by carriage returns, the last version stays.
    """
    if text.isprintable():
        return text
    text = text.rstrip("\r").rpartition("\r")[2]

    def shown(match: re.Match[str]) -> str:
        if match.lastgroup is None:
            return f"\\x{ord(match[0]):02x}"
        return match[0] if keep_colours and match["colour"] else ""

    return _CONTROL.sub(shown, text)


class NonBlockingWriter:
    """Writes to a stream without waiting for its reader.

    A terminal that was stopped with Ctrl+S, or a pager behind a pipe, may read nothing for
    minutes. A launcher that waits for it misses signals, failures and deadlines. So text that the
    reader does not accept now is kept for later.

    A reader that has gone is no error: the run goes on, and its logs are on disk. A stream without
    a file descriptor (in tests) is written to directly.

    Attributes:
        failure: the error that lost text, such as a full disk.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._encoding = "utf-8" if stream is None else stream.encoding or "utf-8"
        self._descriptor: int | None = None
        if stream is not None:
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
            with contextlib.suppress(OSError, ValueError):
                self._descriptor = stream.fileno()
        self._is_gone = stream is None
        self.failure: OSError | None = None
        self._unwritten = bytearray()
        self._poll = select.poll()
        if self._descriptor is not None:
            self._poll.register(self._descriptor, select.POLLOUT)

    @property
    def is_behind(self) -> bool:
        """Whether text waits for the reader."""
        return bool(self._unwritten)

    def write(self, text: str) -> None:
        if self._is_gone:
            return
        if self._descriptor is None:
            assert self._stream is not None
            self._stream.write(text)
            return
        self._unwritten += text.encode(self._encoding, "backslashreplace")
        self.flush()

    def flush(self) -> None:
        """Write the text that the reader accepts now."""
        try:
            while self._unwritten and self._poll.poll(0):
                assert self._descriptor is not None
                written = os.write(self._descriptor, self._unwritten[:_CHUNK_BYTES])
                del self._unwritten[:written]
        except BlockingIOError:  # the descriptor is non-blocking already
            return
        except OSError as error:
            if error.errno not in _READER_IS_GONE:
                self.failure = error
            self._give_up()

    def finish(self, is_enough: Callable[[], bool], patience_s: float | None = None) -> None:
        """Wait until all is written, or until ``is_enough()``.

        ``patience_s`` is how long to wait for a reader that does not read; ``None``: for ever.
        """
        last_progress_s, left = time.monotonic(), len(self._unwritten)
        while self._unwritten:
            self.flush()
            if len(self._unwritten) != left:
                last_progress_s, left = time.monotonic(), len(self._unwritten)
            waited_s = time.monotonic() - last_progress_s
            if is_enough() or (patience_s is not None and waited_s > patience_s):
                self._give_up()
            elif self._unwritten:
                self._poll.poll(_POLL_MS)

    def _give_up(self) -> None:
        self._is_gone = True
        self._unwritten.clear()
        if self._descriptor is not None:
            self._poll.unregister(self._descriptor)


class Reported(Protocol):
    """Reports of a run in progress."""

    @property
    def reports(self) -> Mapping[str, Report]: ...
    @property
    def started_s(self) -> float | None: ...
    @property
    def paused_s(self) -> float: ...
    @property
    def is_paused(self) -> bool: ...


class _Reading(NamedTuple):
    """``wall_s`` is without pauses."""

    wall_s: float
    sim_s: float | None
    sent: int
    discarded: int


class Progress:
    """Progress of a run, read from its reports.

    Args:
        outcome: has the reports.
        wall_s, sim_s: the length of the run, if known; a node may tell it (``node.expect_end``).
        clock: monotonic, seconds.
    """

    def __init__(
        self,
        outcome: Reported,
        wall_s: float | None = None,
        sim_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._outcome = outcome
        self._wall_s = wall_s
        self._sim_s = sim_s
        self._clock = clock
        self._readings: deque[_Reading] = deque()

    @property
    def has_end(self) -> bool:
        return self._wall_s is not None or self._end_sim_s is not None

    def text(self) -> str:
        """All figures in words; empty before the first hook has started."""
        now = self._read()
        return "" if now is None else ", ".join([self._how_far(now), *self._figures(now)])

    def bar(self, columns: int, *, is_ascii: bool) -> str:
        """One line, with a bar if an end is known; at most ``columns - 1`` wide."""
        from tqdm.std import tqdm

        now = self._read()
        if now is None:
            return ""
        if self._wall_s is not None:
            share = min(1.0, self._elapsed_s(now) / self._wall_s)
        elif self._end_sim_s is not None and now.sim_s is not None:
            share = min(1.0, now.sim_s / self._end_sim_s)
        else:
            return self.text()[: columns - 1]
        parts = [self._how_far(now), *self._figures(now)]
        while len(parts) > 2 and len(", ".join(parts)) > columns - _BESIDE_TEXT:
            del parts[-2]  # the last is the time that is left
        text = ", ".join(parts)
        # tqdm formats the bar and the percentage.
        layout = "{percentage:3.0f}%|{bar}| " + text
        line: str = tqdm.format_meter(
            share, 1.0, 1.0, ncols=columns - 1, bar_format=layout, ascii=is_ascii
        )
        return line[: columns - 1]

    @property
    def _end_sim_s(self) -> float | None:
        if self._sim_s is not None:
            return self._sim_s
        ends = [r.expected_end_s for r in self._outcome.reports.values()]
        return max((end for end in ends if end is not None), default=None)

    def _read(self) -> _Reading | None:
        """Sample the reports; the samples of the last seconds are kept for the rates."""
        if self._outcome.started_s is None:
            return None
        reports = self._outcome.reports.values()
        times = [r.sim_time for r in reports if r.sim_time is not None]
        all_metrics = [r.metrics for r in reports if r.metrics is not None]
        reading = _Reading(
            self._clock() - self._outcome.paused_s,
            max(times, default=None),
            sum(c["sent"] for metrics in all_metrics for c in metrics["outgoing"].values()),
            sum(c["discarded"] for metrics in all_metrics for c in metrics["incoming"].values()),
        )
        if self._readings and (self._readings[-1].sim_s or 0.0) > (reading.sim_s or 0.0):
            self._readings.clear()  # a simulator was reset: rates begin anew
        if not self._readings or self._readings[-1][1:] != reading[1:]:
            self._readings.append(reading)
        while len(self._readings) > 2 and reading.wall_s - self._readings[0].wall_s > _WINDOW_S:
            self._readings.popleft()
        return reading

    def _how_far(self, now: _Reading) -> str:
        end_s = self._end_sim_s
        if now.sim_s is not None:
            of = "" if end_s is None or self._wall_s is not None else f" of {end_s:g}"
            return f"{now.sim_s:.1f}{of} s simulated"
        of = "" if self._wall_s is None else f" of {self._wall_s:g}"
        return f"{min(self._elapsed_s(now), self._wall_s or math.inf):.0f}{of} s"

    def _figures(self, now: _Reading) -> list[str]:
        first = self._readings[0]
        passed_s = self._readings[-1].wall_s - first.wall_s
        figures = []
        factor = None
        if passed_s > 0:
            if now.sim_s is not None and first.sim_s is not None:
                factor = (now.sim_s - first.sim_s) / passed_s
                figures.append(f"{factor:.2f} x real time")
            figures.append(f"{(now.sent - first.sent) / passed_s:.0f} packets/s")
        if self._outcome.is_paused:
            figures = ["paused"]
        figures.append(f"{now.discarded} discarded")
        left_s = self._left_s(now, factor)
        if left_s is None:
            return figures
        minutes, seconds = divmod(round(left_s), 60)
        hours, minutes = divmod(minutes, 60)
        left = f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
        return [*figures, f"{left} left"]

    def _left_s(self, now: _Reading, factor: float | None) -> float | None:
        if self._wall_s is not None:
            return max(0.0, self._wall_s - self._elapsed_s(now))
        end_s = self._end_sim_s
        if end_s is None or now.sim_s is None or not factor:
            return None
        return max(0.0, (end_s - now.sim_s) / factor)

    def _elapsed_s(self, now: _Reading) -> float:
        return now.wall_s - (self._outcome.started_s or now.wall_s)
