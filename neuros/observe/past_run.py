"""A run that is over, as its folder tells it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from neuros.errors import UsageError
from neuros.observe.report import FORMAT
from neuros.project.model import Connection


@dataclass(frozen=True)
class PastRun:
    """The folder of a run and its ``run.json``."""

    folder: Path
    record: Mapping[str, Any]

    @cached_property
    def connections(self) -> dict[str, Mapping[str, Any]]:
        """What ``run.json`` has of each connection, by ``a.out -> b.in``, in their order."""
        return {each["connection"]: each for each in self.record["connections"]}

    def connection(self, name: str) -> Connection:
        """A connection as the project has it."""
        return connection_of(name, self.connections[name])


def connection_of(name: str, figures: Mapping[str, Any]) -> Connection:
    """A connection as the project has it, from what ``run.json`` has of it."""
    (source, output), (destination, input_) = (end.split(".") for end in name.split(" -> "))
    limit, queue_size = figures.get("discard_limit"), figures.get("queue_size", 1)
    return Connection(source, output, destination, input_, limit, queue_size, figures["index"])


def open_run(folder: Path) -> PastRun:
    """Read a run folder.

    Raises:
        UsageError: if it is none, the run has not ended, or another version of NeuROS wrote it.
    """
    file = folder / "run.json"
    try:
        record = json.loads(file.read_text("utf-8"))
    except FileNotFoundError as error:
        if any(folder.glob("*/node.json")):
            why = "its run goes on, or its launcher was killed"
        else:
            why = "it is no folder that a run has left behind"
        raise UsageError(f"{folder} has no run.json: {why}") from error
    except OSError as error:
        raise UsageError(f"{file} cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise UsageError(f"{file} is broken ({error}): was the disk full?") from error
    found = record.get("format", 1) if isinstance(record, dict) else None
    if found != FORMAT:
        raise UsageError(
            f"{file} has format {found}, and this version of NeuROS reads format {FORMAT}: use the"
            " version that the run was made with, or run the project again"
        )
    run = PastRun(folder, record)
    try:
        _ = [run.connection(name) for name in run.connections]
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{file} is broken (its connections cannot be read: {error!r})") from error
    return run
