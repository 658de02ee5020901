"""All states of all modelled projects: ``python -m tests.model [NAME ...]``.

Prints how many states each has. The exit code is 1 if a rule is broken in any, or a mutant is not
noticed.
"""

from __future__ import annotations

import argparse
import sys
import time

from .mutants import MUTANTS
from .projects import projects
from .search import search, told


def main() -> int:
    """Search; returns the exit code."""
    parser = argparse.ArgumentParser("python -m tests.model", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="parts of names (all projects)")
    parser.add_argument("--states", type=int, default=1_000_000, help="at most, by project (10^6)")
    options = parser.parse_args()
    is_well = True
    by_name = {project.name: project for project in projects()}
    for name, project in by_name.items():
        if options.names and not any(part in name for part in options.names):
            continue
        began_s = time.monotonic()
        found = search(project, options.states)
        extent = "all" if found.is_complete else "the first"
        result = f"{found.broken}:\n{told(found.trace)}" if found.broken else "every rule holds"
        took_s = time.monotonic() - began_s
        print(f"{name}: {extent} {found.states} states in {took_s:.0f} s: {result}", flush=True)
        is_well = is_well and found.is_complete and not found.broken
    for mutant in MUTANTS if not options.names else ():
        with mutant.apply():
            found = search(by_name[mutant.project], options.states)
        print(f"without the rule that {mutant.rule}: {found.broken or 'NOT NOTICED'}", flush=True)
        is_well = is_well and bool(found.broken)
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
