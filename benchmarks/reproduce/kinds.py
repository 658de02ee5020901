"""What an experiment has to bring along: how its parts are run, read, and shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.page import Section


@dataclass(frozen=True)
class Reading:
    """What one run has come to.

    Attributes:
        figures: by name, with its unit in it; ``None`` where the run could not tell.
        remarks: what is no number, such as the back end.
        series: what figures are drawn of.
    """

    title: str
    name: str
    figures: Mapping[str, float | None]
    remarks: Mapping[str, str]
    series: Any


WEIGHTS = "weights.npz"
"""In the folder of an experiment: weights that ``--weights`` has given."""

ELSEWHERE = (
    "Published numbers are the results in the published sources of NeuROS 1.0. They were measured"
    " on other machines and with another simulator (Gazebo; the Neurorobotics Platform beside it),"
    " and with other implementations of the network. They are here to show what was claimed and"
    " in what shape; the difference between them and the figures of this page is not a measure of"
    " NeuROS."
)

Readings = Mapping[str, Sequence[Reading]]
"""By the name of the part; at least one each."""


@dataclass(frozen=True)
class Kind:
    """An experiment that can be reproduced.

    Attributes:
        parts: what can be run by itself, with what it is called in tables and figures.
        run: part, run folder, seconds, back end; raises whatever goes wrong.
        read: what a run has left behind.
        show: draws figures into a folder; returns the sections of the page.
        shortest_s: what a run has to last at least.
        duration_s: how long it lasts unless somebody says otherwise.
        elsewhere: where published numbers come from.
        trains: the part whose weights the others need, and which ``--weights`` replaces.
    """

    title: str
    introduction: str
    parts: Mapping[str, str]
    run: Callable[[str, Path, float, str], None]
    read: Callable[[Path, Entry], Reading]
    show: Callable[[Readings, Path], Sequence[Section]]
    shortest_s: float = 0.0
    duration_s: float = 20.0
    elsewhere: str = ELSEWHERE
    trains: str = ""
