"""``neuros fork``; ``--help`` and completion read this module, too."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuros.errors import UsageError
from neuros.project.suggest import counted

EXIT_DIFFERENT = 6


def add_fork(fork: argparse.ArgumentParser) -> None:
    fork.description = (
        "Execute a run that has ended again up to a simulated time, then go on with other settings"
        " to its end: a run of its own. Without settings, `neuros verify` finds both identical."
    )
    fork.epilog = (
        "exit codes: those of `neuros launch`; 6 if the fork differs from the run before the time"
    )
    add = fork.add_argument
    add("run", metavar="RUN", type=Path, help="the folder of a run")
    add(
        "--at",
        required=True,
        metavar="TIME",
        help="the moment, in simulated seconds: 12.4sim (the end of the round in which that time is"
        " reached); of a run in virtual time, in seconds of its clock: 12.4",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        help="change a value there (repeatable): nodes.NODE.environment.VARIABLE,"
        " nodes.NODE.parameters.NAME, or NODE.model.FIELD of a MuJoCo model",
    )
    add("-o", "--output", metavar="FOLDER", help="the run folder (default: as neuros launch)")
    add("--backend", metavar="NAME", help="another back end than that of the run")
    add(
        "--duration",
        metavar="SECONDS",
        help="end after so many simulated seconds, from the start on: 30sim (default: as the run)",
    )
    fork.set_defaults(command=_fork)


def _fork(options: argparse.Namespace) -> int:
    from neuros.cli.environments import signals_interrupt
    from neuros_analysis.command import plain_warnings
    from neuros_analysis.forking import fork_run, moment

    at_s, _ = moment(options.at)
    settings = _settings_of(options.set)
    with signals_interrupt([]), plain_warnings():
        forked = fork_run(
            options.run.absolute(),
            options.at,
            settings,
            output=options.output,
            backend=options.backend,
            duration=options.duration,
            show=True,
        )
    if forked.difference:
        print(f"different before {at_s:g} s: {forked.difference}")
        return forked.run.exit_code or EXIT_DIFFERENT
    print(f"identical up to {at_s:g} s: {counted(forked.compared, 'packet')}")
    return forked.run.exit_code


def _settings_of(texts: Sequence[str]) -> dict[str, Any]:
    """The values of ``--set PATH=VALUE``.

    Raises:
        UsageError: for a text without a path or value.
    """
    from neuros.api.changes import CHANGES_IN_WORDS

    found: dict[str, Any] = {}
    for text in texts:
        path, _, value = text.partition("=")
        if not (path and value):
            raise UsageError(f"--set {text}: write PATH=VALUE; {CHANGES_IN_WORDS}")
        found[path] = value
        if path.split(".")[2:3] != ["environment"]:
            try:
                found[path] = json.loads(value)
            except ValueError:
                continue
    return found
