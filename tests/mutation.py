"""Mutation tests of the engine: how many small faults do the tests of tests/engine find?

``pip install cosmic-ray``, then ``python tests/mutation.py --sample 200 --seed 7``. Faults are put
into a copy of the working tree, one at a time. The sample depends on the seed and the source of the
engine only, and Hypothesis draws the same examples each time: scores before and after a change of
the tests can be compared.
"""

from __future__ import annotations

import argparse
import json
import random
import shlex
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("neuros/engine/[!_]*.py"))
TIMEOUT_S = 600
LIMITS = "ulimit -t 60 -v 6000000"  # a fault may make a test endless, or its lists
# One replacement for each arithmetic operator, and for comparisons the neighbour or the opposite:
# tests that find these find the others, too. Annotations hold the only `|`.
ARITHMETIC = {"Add_Sub", "Sub_Add", "Mul_Add", "FloorDiv_Mul", "Pow_Mul"}
COMPARISON = {
    "Lt_LtE",
    "LtE_Lt",
    "Gt_GtE",
    "GtE_Gt",
    "Eq_NotEq",
    "NotEq_Eq",
    "Is_IsNot",
    "IsNot_Is",
}


class Fault(NamedTuple):
    """A mutation of the source."""

    module: str
    line: int
    column: int
    operator: str
    occurrence: int
    arguments: str
    job: str

    @property
    def is_telling(self) -> bool:
        """Whether it says something that no other fault at the same place says."""
        kind, _, change = self.operator.removeprefix("core/").partition("Operator_")
        if kind == "ReplaceBinary":
            return change in ARITHMETIC
        return kind != "ReplaceComparison" or change in COMPARISON


def main() -> int:
    """Put a sample of faults into a copy of the working tree, and say which ones no test found."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--sample", type=int, default=200, help="faults (default 200)")
    parser.add_argument("--seed", type=int, default=7, help="of the sample (default 7)")
    parser.add_argument("--only", nargs="*", default=[], metavar="FAULT", help="as MODULE:LINE")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copy_of_the_working_tree(Path(folder))
        session = Path(folder, "session.sqlite")
        cosmic_ray(Path(folder), "init", session)
        faults = choose(session, options.sample, options.seed, options.only)
        print(f"{len(faults)} faults in {', '.join(MODULES)}", flush=True)
        cosmic_ray(Path(folder), "exec", session)
        return report(session, faults)


def copy_of_the_working_tree(folder: Path) -> None:
    """Copy all that git would commit, and write the settings of cosmic-ray beside it."""
    listed = subprocess.check_output(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, text=True
    )
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    tests = sorted((folder / "tests/engine").glob("test_*.py"), key=_draws_examples)
    names = [str(path.relative_to(folder)) for path in tests]
    pytest = [sys.executable, "-m", "pytest", "-xq", "-p", "no:cacheprovider", "-p", "no:xdist"]
    command = shlex.join([*pytest, "--hypothesis-profile=mutation", *names])
    settings = {
        "module-path": MODULES,
        "timeout": float(TIMEOUT_S),
        "excluded-modules": [],
        "test-command": shlex.join(["bash", "-c", f"{LIMITS}; exec {command}"]),
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    (folder / "mutation.toml").write_text(
        "\n".join(["[cosmic-ray]", *lines, "[cosmic-ray.distributor]", 'name = "local"', ""])
    )
    subprocess.run(shlex.split(command), cwd=folder, check=True)


def _draws_examples(test: Path) -> bool:
    """Whether it uses Hypothesis, and so takes long: the others come first."""
    return "import hypothesis" in (text := test.read_text("utf-8")) or "from hypothesis" in text


def cosmic_ray(folder: Path, command: str, session: Path) -> None:
    """Run ``cosmic-ray COMMAND`` on the copy."""
    subprocess.run(
        [sys.executable, "-m", "cosmic_ray.cli", command, "mutation.toml", session],
        cwd=folder,
        check=True,
    )


def choose(session: Path, count: int, seed: int, only: Iterable[str]) -> list[Fault]:
    """Leave only a sample in the session, or only the faults at some lines."""
    columns = "module_path, start_pos_row, start_pos_col, operator_name, occurrence"
    query = f"select {columns}, operator_args, job_id from mutation_specs"
    with closing(sqlite3.connect(session)) as database, database:
        faults = sorted(Fault(*row) for row in database.execute(query))
        faults = [fault for fault in faults if fault.is_telling]
        if wanted := set(only):
            chosen = [f for f in faults if f"{Path(f.module).stem}:{f.line}" in wanted]
        else:
            chosen = sorted(random.Random(seed).sample(faults, min(count, len(faults))))
        database.execute("create temporary table chosen (job_id)")
        database.executemany("insert into chosen values (?)", [[fault.job] for fault in chosen])
        for table in ("mutation_specs", "work_items"):
            database.execute(f"delete from {table} where job_id not in (select job_id from chosen)")
    return chosen


def report(session: Path, faults: Iterable[Fault]) -> int:
    """Print the faults that survived, and the score of each module; returns 1 if some did."""
    with closing(sqlite3.connect(session)) as database:
        results = {
            job: (outcome, diff)
            for job, outcome, diff in database.execute(
                "select job_id, test_outcome, diff from work_results"
            )
        }
    found, all_faults = Counter[str](), Counter[str]()
    for fault in faults:
        outcome, diff = results[fault.job]
        all_faults[fault.module] += 1
        found[fault.module] += outcome == "KILLED"
        if outcome != "KILLED":
            print(f"\n{fault.module}:{fault.line}: {fault.operator}: {str(outcome).lower()}")
            changed = [line for line in diff.splitlines() if line[:1] in "+-"]
            print("\n".join(line for line in changed if line[:3] not in ("+++", "---")))
    print()
    for module, count in all_faults.items():
        print(f"{module}: {found[module]} of {count} found")
    total = sum(found.values())
    print(f"{total} of {len(results)} found: {100 * total / max(1, len(results)):.1f} %")
    return 0 if total == len(results) else 1


if __name__ == "__main__":
    sys.exit(main())
