"""``run.json``, the record of a run as a file: the one module that writes and reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuros.errors import EnvironmentFault, UsageError
from neuros.ordinary_files import write_whole
from neuros.project.model import NodeFile
from neuros.project.scanner import read_bytes
from neuros.project.split import node_file_from_json
from neuros.project.validate import mistake

RUN_FILE = "run.json"
FORMAT = 2
"""Grows when a reader of the old one could no longer read the new one."""


def write_run_file(record: Mapping[str, Any], folder: Path) -> None:
    """Write the whole record, or nothing. Raises ``OSError``."""
    write_whole(folder / RUN_FILE, f"{json.dumps(record, indent=2)}\n".encode())


def read_run_file(folder: Path) -> dict[str, Any]:
    """Read the record in a run folder.

    Raises:
        UsageError: if there is no record, or another version of NeuROS wrote it.
        EnvironmentFault: if it is damaged.
    """
    file = folder / RUN_FILE
    try:
        record = read_object(file)
    except FileNotFoundError as error:
        if any(folder.glob("*/node.json")):
            why = "its run goes on, or its launcher was killed"
        else:
            why = "it is not the folder of a run"
        raise UsageError(f"{folder} has no {RUN_FILE}: {why}") from error
    found = record.get("format")
    if found != FORMAT:
        raise UsageError(
            f"{file} has format {found}, and this version of NeuROS reads format {FORMAT}: use the"
            " version that the run was made with, or run the project again"
        )
    check_record(record, file)
    return record


def check_record(record: Mapping[str, Any], file: Path) -> None:
    """Raise ``EnvironmentFault`` for a record that breaks the schema of ``run.json``."""
    if wrong := mistake(record, "run"):
        raise EnvironmentFault(f"{file} is broken: {wrong}")


def read_node_file(folder: Path) -> NodeFile:
    """Read ``node.json`` in the folder of a node.

    Raises:
        FileNotFoundError, NotADirectoryError: if there is no such file.
        EnvironmentFault: if it cannot be read, or is damaged.
    """
    file = folder / "node.json"
    content = read_object(file)
    try:
        if wrong := mistake(content, "node", "#/$defs/node_file"):
            raise EnvironmentFault(f"{file} is broken: {wrong}")
        told = node_file_from_json(content)
    except (ValueError, TypeError, OverflowError) as error:
        raise EnvironmentFault(f"{file} is broken ({error})") from error
    if told.node.name != folder.name:
        raise EnvironmentFault(f"{file} is broken: it is of a node '{told.node.name}'")
    return told


def read_object(file: Path) -> dict[str, Any]:
    """Read the JSON object in a file of a run folder.

    Raises:
        FileNotFoundError, NotADirectoryError: if there is no such file.
        EnvironmentFault: if it cannot be read, or holds something else.
    """
    try:
        found = json.loads(read_bytes(file))
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise EnvironmentFault(f"{file} cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise EnvironmentFault(f"{file} is broken ({error}): was the disk full?") from error
    if not isinstance(found, dict):
        raise EnvironmentFault(f"{file} is broken: it holds no object")
    return found
