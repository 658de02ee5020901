"""``neuros doctor``: looks at the machine, line by line, and proves that packets arrive."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator

from neuros.doctor.findings import Finding, State

_EPILOG = """\
exit codes:
  0    nothing is wrong
  4    something is: the lines that begin with PROBLEM say what, and what to do
"""


def add_doctor(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the grammar."""
    doctor = commands.add_parser(
        "doctor",
        help="check this machine, and prove that packets arrive",
        description="Check what runs need of this machine, and prove with packets between two"
        " nodes that they can talk, on each back end that there is.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    doctor.add_argument(
        "--no-delivery", action="store_true", help="only look: start no nodes and no containers"
    )
    doctor.set_defaults(command=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    is_well = True
    for finding in _findings(proves=not options.no_delivery):
        print(finding, flush=True)  # the proofs take seconds
        is_well &= finding.state is not State.BAD
    return 0 if is_well else 4


def _findings(*, proves: bool) -> Iterator[Finding]:
    from neuros.cli.containers import STANDARD
    from neuros.doctor.containers import look_at_containers
    from neuros.doctor.delivery import prove_delivery
    from neuros.doctor.machine import look_at_machine, prove_rendering

    yield from look_at_machine(os.environ)
    yield prove_rendering(os.environ)
    has_base = False
    for finding in look_at_containers(STANDARD, os.environ):
        has_base |= finding.state is State.GOOD and finding.text.startswith("neuros_python:")
        yield finding
    if not proves:
        return
    for backend in ("in-process", "process", *(["docker"] if has_base else [])):
        yield prove_delivery(backend)
