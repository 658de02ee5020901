"""The fault matrix: what may go wrong in a plugin, where, and what must come of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

BACKENDS = ("process", "in-process", "docker")
PLACES = ("import", "initialise", "tick", "function", "finalise", "thread")


class Kind(Enum):
    """What a fault does to the node in which it strikes."""

    DIES = "its process ends"
    RAISES = "an exception leaves the plugin"
    HANGS = "the thread never comes back"
    BLOCKS = "no thread of the process goes on"
    CUT_OFF = "nothing that it had open is there any more"
    LIVES = "the node can go on"


FAULTS = {
    "kill": Kind.DIES,
    "segfault": Kind.DIES,
    "os_exit": Kind.DIES,
    "exception": Kind.RAISES,
    "out_of_memory": Kind.RAISES,
    "sys_exit": Kind.RAISES,
    "loop_in_python": Kind.HANGS,
    "loop_in_c": Kind.BLOCKS,
    "close_descriptors": Kind.CUT_OFF,
    "stop_and_continue": Kind.LIVES,
    "fork": Kind.LIVES,
    "change_signals": Kind.LIVES,
    "flood_output": Kind.LIVES,
    "binary_output": Kind.LIVES,
}


@dataclass(frozen=True)
class Cell:
    """One fault at one place on one back end."""

    fault: str
    place: str
    backend: str

    def __str__(self) -> str:
        return f"{self.fault} at {self.place}, {self.backend}"

    @property
    def kind(self) -> Kind:
        """What the fault does."""
        return FAULTS[self.fault]

    @property
    def is_survived(self) -> bool:
        """Whether the run goes on to its end, with exit code 0.

        Python prints an exception of a thread and goes on, and so does a loop beside the hooks.
        """
        in_thread = self.place == "thread" and self.kind in (Kind.RAISES, Kind.HANGS)
        return self.kind is Kind.LIVES or in_thread

    @property
    def is_before_start(self) -> bool:
        """Whether it strikes before ``--duration`` has begun to count."""
        return self.place in ("import", "initialise")

    @property
    def needs_interrupt(self) -> bool:
        """Whether only Ctrl+C ends the run."""
        return self.kind in (Kind.HANGS, Kind.BLOCKS) and self.is_before_start

    @property
    def ends_by_itself(self) -> bool:
        """Whether the run ends when its duration is over, and not earlier."""
        hangs = self.kind in (Kind.HANGS, Kind.BLOCKS) and not self.needs_interrupt
        return self.is_survived or hangs

    @property
    def may_be_cut_short(self) -> bool:
        """Whether a busy machine may need longer than the 5 s that a node has to end."""
        return self.fault == "flood_output" and self.place == "finalise"

    @property
    def exit_codes(self) -> tuple[int, ...]:
        """Those that are right."""
        if self.may_be_cut_short:
            return (0, 1)
        if self.is_survived:
            return (0,)
        return (130,) if self.needs_interrupt else (1,)


def all_cells() -> Iterator[Cell]:
    """The whole matrix."""
    for backend in BACKENDS:
        for fault in FAULTS:
            for place in PLACES:
                yield Cell(fault, place, backend)
