"""Processes are read side by side, and nobody waits for one that takes long."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from neuros.launcher.stall_detector import ThreadReader
from neuros.ports import RunningNode
from neuros.stacks import ProcessThreads

READ = ProcessThreads(problem="read")
AGAIN = ProcessThreads(problem="read again")


@dataclass
class Process:
    threads: Callable[[], ProcessThreads]


def reader_of(**processes: Callable[[], ProcessThreads]) -> ThreadReader:
    def process_of(name: str) -> RunningNode | None:
        return cast(RunningNode, Process(processes[name])) if name in processes else None

    return ThreadReader(process_of)


def test_what_is_read_is_there_when_it_is_there() -> None:
    goes_on = threading.Event()
    reader = reader_of(quick=lambda: READ, slow=lambda: (goes_on.wait(), READ)[1])
    for name in ("slow", "quick", "ended"):
        reader.begin(name)
    assert reader.read("slow") is None
    reader.wait(0.05)
    assert reader.read("slow") is None, "it has not been waited for"
    goes_on.set()
    reader.wait(10.0)
    assert [reader.read(name) for name in ("slow", "quick")] == [READ, READ]
    assert reader.read("ended") == ProcessThreads()
    assert reader.read("another") is None, "nobody has asked"


def test_a_process_is_read_once_until_it_goes_on() -> None:
    reads = [READ, AGAIN]
    reader = reader_of(a=lambda: reads.pop(0))
    for expected in (READ, READ):
        reader.begin("a")
        reader.wait(10.0)
        assert reader.read("a") == expected
    reader.forget("a")
    assert reader.read("a") is None
    reader.begin("a")
    reader.wait(10.0)
    assert reader.read("a") == AGAIN


def test_in_the_end_nothing_reads_any_more() -> None:
    done: list[str] = []

    def slow(name: str) -> Callable[[], ProcessThreads]:
        return lambda: (time.sleep(0.2), done.append(name), READ)[2]

    reader = reader_of(a=slow("a"), b=slow("b"))
    reader.begin("a")
    reader.forget("a")
    reader.begin("b")
    reader.close()
    assert sorted(done) == ["a", "b"]


def test_what_fails_is_told() -> None:
    def fails() -> ProcessThreads:
        raise RuntimeError("of another back end")

    reader = reader_of(a=fails)
    reader.begin("a")
    reader.wait(10.0)
    assert reader.read("a") == ProcessThreads(problem="RuntimeError('of another back end')")
