"""An extension: a diary of runs, with a command, an option of ``neuros launch`` and a check."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from neuros.errors import EnvironmentFault
from neuros.options import Option
from neuros.ports import (
    BackEnd,
    Finding,
    Guardian,
    LaunchExtension,
    MachineCheck,
    Shown,
    Subcommand,
)

COMMAND = Subcommand("neuros_diary", "print the diary of runs")


def diary_file(environ: Mapping[str, str]) -> Path:
    """The file with a line per run."""
    return Path(environ.get("DIARY", "~/diary.txt")).expanduser()


def add_diary(parser: argparse.ArgumentParser) -> None:
    """``neuros diary``: its arguments, and the function that runs it."""
    parser.add_argument("word", nargs="?", default="", help="print only lines with this word")
    parser.set_defaults(command=print_diary)


def print_diary(parsed: argparse.Namespace) -> int:
    """Returns the exit code."""
    for line in diary_file(os.environ).read_text("utf-8").splitlines():
        if parsed.word in line:
            print(line)
    return 0


class Entry:
    """The line of one run (:class:`neuros.ports.View`)."""

    def __init__(self, text: str) -> None:
        self._text = text

    def start(self, run: Shown, guardian: Guardian, log: Callable[[str, str], None]) -> None:
        with diary_file(os.environ).open("a", encoding="utf-8") as file:
            file.write(f"{run.project.name}: {self._text} ({run.folder})\n")

    def finish(self) -> None:
        """The line is complete."""


class Diary(LaunchExtension, MachineCheck):
    """``neuros launch --diary TEXT``, and the line of ``neuros doctor``."""

    options = (Option(("--diary",), "write this about the run into the diary", metavar="TEXT"),)

    def prepare(
        self, options: Mapping[str, Any], back_end: BackEnd, *, is_isolated: bool
    ) -> Entry | None:
        if options["diary"] is None:
            return None
        for finding in self.checks(os.environ):
            if finding.remedy:
                raise EnvironmentFault(f"--diary: {finding.text}: {finding.remedy}")
        return Entry(options["diary"])

    def checks(self, environ: Mapping[str, str]) -> Iterator[Finding]:
        file = diary_file(environ)
        if os.access(file if file.exists() else file.parent, os.W_OK):
            yield Finding.good("diary", str(file))
        else:
            yield Finding.bad("diary", f"{file} cannot be written", "set DIARY to another file")


LAUNCH = CHECK = Diary()
