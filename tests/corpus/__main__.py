"""Files of others by command: ``python -m tests.corpus --table docs/other_peoples_files.md``.

Fetches the packages of ``packages.txt``, converts, loads and steps every description in them,
builds the messages, and compares all with independent readers. The exit code is 1 if anything is
found that ``differences.txt`` does not list, or if a row of it is no longer true.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.support.tables import write_table

from .checking import Listed, Outcome, check, files_of, listed, unlisted
from .fetching import Unreached, requirements, unpacked
from .messages import check_messages

_HEAD = (
    "| package | files | load | refused | bodies compared | joints compared"
    " | differences, each named by the converter | farthest body |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def main() -> int:
    """Check; returns the exit code."""
    options = _options()
    names = options.package or [row.partition("==")[0] for group in requirements() for row in group]
    known, rows, failures = listed(), list[str](), list[str]()
    for name in names:
        try:
            folder = unpacked(name)
        except Unreached as error:
            failures.append(str(error))
            continue
        if name.endswith("-msgs"):
            with tempfile.TemporaryDirectory(prefix="neuros-corpus-") as bench:
                package = name.removeprefix("ros-").replace("-", "_")
                types, problems = check_messages(package, folder, Path(bench))
            failures += problems
            rows.append(
                f"| {folder.name} | {types} types, whose hashes are ROS's |  |  |  |  |  |  |"
            )
            print(rows[-1], flush=True)
            continue
        outcomes = [check(file, folder) for file in files_of(folder)]
        failures += [text for outcome in outcomes for text in unlisted(outcome, known)]
        rows.append(_row(folder.name, outcomes))
        print(rows[-1], flush=True)
    if not options.package:
        failures += [
            f"differences.txt: no longer true: {r.file}: {r.what}" for r in known if not r.uses
        ]
    print(*failures, f"{len(failures)} differences that are not listed", sep="\n")
    if options.table:
        write_table(options.table, "\n".join([_HEAD, *rows, "", *_reasons(known)]))
    return 1 if failures else 0


def _row(name: str, outcomes: Sequence[Outcome]) -> str:
    loaded = [each for each in outcomes if not each.refused]
    cells = [
        *(name, len(outcomes), len(loaded), len(outcomes) - len(loaded)),
        *(f"{sum(getattr(o, key) for o in outcomes):,}" for key in ("bodies", "joints", "said")),
        f"{max(o.apart_m for o in loaded):.0e} m" if loaded else "",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def _reasons(known: Sequence[Listed]) -> list[str]:
    """The table of what is refused or different, by reason."""
    uses: dict[tuple[str, str], int] = {}
    for row in known:
        key = row.file.partition("/")[0], row.why
        uses[key] = uses.get(key, 0) + row.uses
    rows = [f"| {package} | {count} | {why} |" for (package, why), count in uses.items()]
    return ["| package | findings | reason |", "| --- | ---: | --- |", *rows]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.corpus", description=__doc__)
    parser.add_argument("--package", action="append", metavar="NAME", help="repeatable (all)")
    parser.add_argument("--table", type=Path, metavar="FILE", help="put the tables into this page")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
