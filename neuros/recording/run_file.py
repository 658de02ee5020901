"""``run.json``, the record of a run as a file: the one module that writes and reads it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuros.errors import UsageError

RUN_FILE = "run.json"
FORMAT = 2
"""Grows when a reader of the old one could no longer read the new one."""


def write_run_file(record: Mapping[str, Any], folder: Path) -> None:
    """Write it, the whole of it or nothing. Raises ``OSError``."""
    part = folder / f".{RUN_FILE}"
    try:
        part.write_text(json.dumps(record, indent=2) + "\n", "utf-8")
        part.replace(folder / RUN_FILE)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def read_run_file(folder: Path) -> dict[str, Any]:
    """The record of the run that has left this folder behind.

    Raises:
        UsageError: if there is none, it is broken, or another version of NeuROS wrote it.
    """
    file = folder / RUN_FILE
    try:
        record = json.loads(file.read_text("utf-8"))
    except FileNotFoundError as error:
        if any(folder.glob("*/node.json")):
            why = "its run goes on, or its launcher was killed"
        else:
            why = "it is no folder that a run has left behind"
        raise UsageError(f"{folder} has no {RUN_FILE}: {why}") from error
    except OSError as error:
        raise UsageError(f"{file} cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise UsageError(f"{file} is broken ({error}): was the disk full?") from error
    if not isinstance(record, dict):
        raise UsageError(f"{file} is broken: it holds no object")
    found = record.get("format")
    if found != FORMAT:
        raise UsageError(
            f"{file} has format {found}, and this version of NeuROS reads format {FORMAT}: use the"
            " version that the run was made with, or run the project again"
        )
    return record
