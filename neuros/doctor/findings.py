"""What a check has found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class State(Enum):
    """How good a finding is."""

    GOOD = "ok"
    ABSENT = "-"
    """Something that is not there and need not be."""
    BAD = "PROBLEM"


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        subject: what was looked at, "Python".
        text: what was found.
        remedy: what to do about it, where there is something to do.
    """

    state: State
    subject: str
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        remedy = f": {self.remedy}" if self.remedy else ""
        return f"{self.state.value:<8} {self.subject:<12} {self.text}{remedy}"


def good(subject: str, text: str) -> Finding:
    """It is as it should be."""
    return Finding(State.GOOD, subject, text)


def absent(subject: str, text: str, remedy: str = "") -> Finding:
    """It is not there, and projects run without it."""
    return Finding(State.ABSENT, subject, text, remedy)


def bad(subject: str, text: str, remedy: str = "") -> Finding:
    """Projects do not run, or not well, because of it."""
    return Finding(State.BAD, subject, text, remedy)
