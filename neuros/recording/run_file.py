"""``run.json``, the record of a run as a file: the one module that writes and reads it."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.scanner import read_bytes

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
        UsageError: if there is none, or another version of NeuROS wrote it.
        EnvironmentFault: if it is damaged.
    """
    file = folder / RUN_FILE
    try:
        record = read_object(file)
    except FileNotFoundError as error:
        if any(folder.glob("*/node.json")):
            why = "its run goes on, or its launcher was killed"
        else:
            why = "it is no folder that a run has left behind"
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
    """Raise ``EnvironmentFault`` for a record, of a file, that does not describe a run."""
    if wrong := _mistake(record, _RECORD):
        raise EnvironmentFault(f"{file} is broken: {wrong}")


def read_object(file: Path) -> dict[str, Any]:
    """The JSON object in a file of a run folder.

    Raises:
        FileNotFoundError, NotADirectoryError: if there is no such file.
        EnvironmentFault: if it cannot be read, or holds anything else.
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


# ---------------------------------------------------------------------- what readers rely on


class _Kind(NamedTuple):
    """A scalar: what is allowed, in words, and how that is told."""

    words: str
    fits: Callable[[Any], bool]


class _Object(NamedTuple):
    """An object: members that it must have, and others that it may have, or have as null."""

    required: Mapping[str, Any]
    others: Mapping[str, Any]


class _Map(NamedTuple):
    """An object whose members are all of one form; keys may be bound to a pattern."""

    member: Any
    keys: re.Pattern[str] = re.compile(r".*", re.DOTALL)


class _List(NamedTuple):
    item: Any


class _Row(NamedTuple):
    items: tuple[Any, ...]


def _is_number(value: Any) -> bool:
    # As a comparison with it, that of a NaN is false.
    return isinstance(value, int | float) and type(value) is not bool and abs(value) < 1 << 63


_NAME = r"_?[A-Za-z][A-Za-z0-9_]*"
_WIRE = re.compile(rf"{_NAME}\.{_NAME} -> {_NAME}\.{_NAME}")
NODE_NAME = re.compile(_NAME)
_NUMBER = _Kind("a number", _is_number)
_COUNT = _Kind("a count", lambda value: type(value) is int and 0 <= value < 1 << 63)
_CHANGE = _Kind("a whole number", lambda value: type(value) is int and abs(value) < 1 << 63)
_TEXT = _Kind("a text", lambda value: isinstance(value, str))
_ENDS = _Kind(
    "'a.out -> b.in'", lambda value: isinstance(value, str) and bool(_WIRE.fullmatch(value))
)
_SECONDS = _Map(_NUMBER)
_CONNECTION = _Object(
    {"connection": _ENDS, "index": _COUNT},
    {
        **dict.fromkeys(("discard_limit", "queue_size", "sent", "received", "consumed"), _COUNT),
        **dict.fromkeys(("discarded", "unread", "longest_discard"), _COUNT),
        "lost": _CHANGE,
        "rate_hz": _NUMBER,
        "latency_ms": _SECONDS,
        "digests": _Map(_Kind("a text or number", lambda v: isinstance(v, str) or _is_number(v))),
    },
)
_TICKS = _Object(
    {"period_ms": _NUMBER, "std_ms": _NUMBER, "within": _SECONDS},
    {"histogram": _List(_Row((_NUMBER, _NUMBER)))},
)
_NODE_FIGURES = _Object(
    {},
    {
        "accounting": _Object(
            {},
            {
                **dict.fromkeys(("executing", "waiting", "blocked"), _SECONDS),
                **dict.fromkeys(("idle", "scheduling", "registering"), _NUMBER),
            },
        ),
        "hooks": _Map(_Object({}, {"initialise_s": _NUMBER, "ticks": _TICKS})),
        "sim_time": _NUMBER,
        "report": _TEXT,
        "results": _Map(None),
        "stack": _TEXT,
    },
)
_LOAD = _Object(
    dict.fromkeys(("cpu_percent_mean", "cpu_percent_max"), _NUMBER),
    dict.fromkeys(("memory_bytes_max", "memory_used_bytes_max", "threads_max", "cores"), _NUMBER),
)
_RECORD = _Object(
    {},
    {
        **dict.fromkeys(("project", "file", "reason", "backend"), _TEXT),
        **dict.fromkeys(("wall_s", "sim_s", "running_s", "paused_s"), _NUMBER),
        "started": _Kind("seconds since 1970", lambda v: _is_number(v) and 0 <= v < 2.5e11),
        "exit_code": _CHANGE,
        "real_time_factor": _NUMBER,
        "command": _List(_TEXT),
        "timeline": _Map(_List(_Row((_NUMBER, _NUMBER)))),
        "connections": _List(_CONNECTION),
        "nodes": _Map(_NODE_FIGURES, NODE_NAME),
        "broken_budgets": _List(_TEXT),
        "machine": _Object({}, {"cores": _COUNT, "memory_bytes": _NUMBER}),
        "versions": _Map(None),
        "git": _Map(None),
        "seeds": _Map(_Map(None)),
        "system_load": _Object({}, {"machine": _LOAD, "processes": _Map(_LOAD), "samples": _COUNT}),
        "recording": _Object({}, {"topics": _Map(_Object({}, {"recorded": _COUNT}))}),
        "expanded_project": _Object({}, {"nodes": _List(_Object({"name": _TEXT}, {}))}),
    },
)


def _mistake(value: Any, form: Any, place: str = "") -> str:
    """What is wrong with a value, empty if nothing is."""
    parts: list[tuple[str, Any, Any]] = []
    match form:
        case None:
            return ""
        case _Kind():
            return "" if form.fits(value) else f"{place} must be {form.words}"
        case _List():
            if type(value) is not list:
                return f"{place} must be a list"
            parts = [(f"{place}/{index}", each, form.item) for index, each in enumerate(value)]
        case _Row():
            if type(value) is not list or len(value) != len(form.items):
                return f"{place} must be a list of {len(form.items)}"
            parts = [(place, *each) for each in zip(value, form.items, strict=True)]
        case _Map() | _Object() if type(value) is not dict:
            return f"{place or 'the whole'} must be an object"
        case _Map():
            if wrong := next((key for key in value if not form.keys.fullmatch(key)), None):
                return f"{place} has the impossible name '{wrong}'"
            members = value.items()
            parts = [
                (f"{place}/{key}", each, form.member) for key, each in members if each is not None
            ]
        case _Object(required, others):
            if missing := required.keys() - value.keys():
                return f"{place} has no '{min(missing)}'"
            parts = [(f"{place}/{key}", value[key], each) for key, each in required.items()]
            known = ((key, each) for key, each in others.items() if value.get(key) is not None)
            parts += [(f"{place}/{key}", value[key], each) for key, each in known]
    found = (_mistake(each, inner, where) for where, each, inner in parts)
    return next(filter(None, found), "")
