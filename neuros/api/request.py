"""Request for a run: the options of ``neuros launch``, as Python values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from neuros.backends.registered import AUTO
from neuros.errors import UsageError
from neuros.recording.selection import Request as RecordingRequest


@dataclass(frozen=True)
class Duration:
    """How long a run lasts: wall seconds, or simulated seconds; neither: until it ends itself."""

    wall_s: float | None = None
    sim_s: float | None = None


@dataclass(frozen=True)
class Request:
    """How to run a project; the defaults are those of ``neuros launch``.

    Attributes:
        backend: the name of a back end, or ``auto``.
        backend_options: values of its own options, by name.
        nodes: those to start, all if empty; the others may run elsewhere.
        duration: when to end it.
        domain_id: the ROS domain, chosen if ``None``.
        network, peers: how far nodes look for others, as the options of the same names.
        output: the run folder; ``None``: ``runs/<project>/<utc time>`` in the current folder.
        is_placed: whether nodes get the cores that they ask for.
        has_digests: whether digests of packets are kept in process, too.
        monitors_load: whether to write what the run takes of the machine.
        shows_progress: whether to show how far it has come; ``None``: if its end is known.
        recording: what is recorded, ``None``: nothing.
        is_verbose: whether DEBUG records are logged.
    """

    backend: str = AUTO
    backend_options: Mapping[str, Any] = field(default_factory=dict)
    nodes: tuple[str, ...] = ()
    duration: Duration = field(default_factory=Duration)
    domain_id: int | None = None
    network: bool = False
    peers: str | None = None
    output: str | None = None
    is_placed: bool = True
    has_digests: bool = False
    monitors_load: bool = False
    shows_progress: bool | None = None
    recording: RecordingRequest | None = None
    is_verbose: bool = False


def parse_duration(text: str | None) -> Duration:
    """``30``, ``0.5``, or ``30sim``.

    Raises:
        UsageError: for anything else.
    """
    if text is None:
        return Duration()
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)(sim)?", text.strip())
    if match is None or float(match[1]) <= 0:
        raise UsageError(f"--duration {text}: give seconds, as 30, or 30sim for simulated time")
    seconds = float(match[1])
    return Duration(sim_s=seconds) if match[2] else Duration(wall_s=seconds)
