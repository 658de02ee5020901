"""Fuzzing by command: ``python -m tests.fuzz --hours 1``, ``--target NAME``, ``--keep DIR``.

Each target has a process of its own, so that a crash is a finding, too. Of JSON, each value is
changed in turn. Then inputs are guided by coverage where atheris is installed (``pip install
atheris``), else made by chance. The exit code is 1 if anything was found.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import itertools
import json
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).resolve().parent
MEMORY_BYTES = 1 << 30
"""What a process may take beyond what it has when it begins."""
_SILENCE_S = 180
_REPORT_S = 1.0


@dataclass
class Tally:
    """What became of a target.

    Attributes:
        findings: by their digest, the last line of what was said.
    """

    executions: int = 0
    seconds: float = 0.0
    findings: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, data: bytes, fault: str, keep: Path) -> None:
        """Note a finding; one place is one finding."""
        lines = fault.strip().splitlines()
        place = [line for line in lines if line.startswith("  File")][-1:]
        key = hashlib.sha256("".join([*place, lines[-1][:40]]).encode()).hexdigest()[:12]
        if key not in self.findings:
            self.findings[key] = lines[-1][:300]
            (keep / f"{name}-{key}").write_bytes(data)
            (keep / f"{name}-{key}.txt").write_text(fault, "utf-8", "backslashreplace")


def main() -> int:
    """Run the targets; returns the exit code."""
    options = _options()
    if options.child:
        return _child(options)
    names = options.target or _names()
    keep = options.keep or Path(tempfile.mkdtemp(prefix="neuros-fuzz-findings-"))
    keep.mkdir(parents=True, exist_ok=True)
    seconds = options.hours * 3600 / len(names)
    tallies = {name: _in_process(name, seconds, keep, options) for name in names}
    found = sum(len(tally.findings) for tally in tallies.values())
    print(f"{sum(t.executions for t in tallies.values())} inputs, {found} findings in {keep}")
    if not found and not options.keep:
        keep.rmdir()
    if options.table:
        _write(options.table, table(tallies))
    return 1 if found else 0


def _in_process(name: str, seconds: float, keep: Path, options: argparse.Namespace) -> Tally:
    with tempfile.TemporaryDirectory(prefix="neuros-fuzz-") as folder:
        command = [sys.executable, "-m", "tests.fuzz", "--child", folder, "--target", name]
        command += [
            "--hours",
            str(seconds / 3600),
            "--seed",
            str(options.seed),
            "--keep",
            str(keep),
        ]
        command += [] if options.guided else ["--by-chance"]
        begin_s = time.monotonic()
        seen = -1
        with open(Path(folder) / "said", "wb") as said:
            child = subprocess.Popen(command, stdout=said, stderr=said, cwd=HERE.parents[1])
        heard_s = time.monotonic()
        while child.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(_REPORT_S)
            tally = _tally_in(Path(folder))
            if tally.executions != seen:
                seen, heard_s = tally.executions, time.monotonic()
            if time.monotonic() - heard_s > _SILENCE_S:
                child.kill()
        tally = _tally_in(Path(folder))
        tally.seconds = time.monotonic() - begin_s
        if child.returncode:
            last = Path(folder) / "input"
            text = (Path(folder) / "said").read_text("utf-8", "replace")[-3000:]
            fault = f"{text}\nthe process ended with {child.returncode}"
            tally.add(name, last.read_bytes() if last.exists() else b"", fault, keep)
    print(f"{name:20} {tally.executions:9} inputs in {tally.seconds:5.0f} s", flush=True)
    for key, text in tally.findings.items():
        print(f"    {key}: {text}", flush=True)
    return tally


def _tally_in(folder: Path) -> Tally:
    try:
        return Tally(**json.loads((folder / "tally").read_text()))
    except (OSError, ValueError):
        return Tally()


# ---------------------------------------------------------------------- the process of a target


def _child(options: argparse.Namespace) -> int:
    folder, (name,) = Path(options.child), options.target
    is_guided = options.guided and find_spec("atheris") is not None
    if is_guided:
        import atheris

        with atheris.instrument_imports(include=["neuros"]):
            from . import running, targets
    else:
        from . import running, targets
    from .mutation import changed, each_change_of_json

    target = targets.TARGETS[name]
    seeds, tally = target.seeds(), Tally()
    for kept in sorted((HERE / "corpus" / name).glob("*")):
        seeds = [*seeds, kept.read_bytes()]
    for data in seeds[:20]:  # so that all is imported before memory is limited
        if fault := running.fault_of(target, data):
            tally.add(name, data, fault, options.keep)
    _limit_memory()
    begin_s = told_s = time.monotonic()

    def one(data: bytes) -> None:
        nonlocal told_s
        (folder / "input").write_bytes(data)
        if fault := running.fault_of(target, data):
            tally.add(name, data, fault, options.keep)
        tally.executions += 1
        if time.monotonic() - told_s > _REPORT_S or fault:
            told_s = time.monotonic()
            _tell(tally, folder)

    end_s = begin_s + options.hours * 3600
    ordinary = target.seeds() if target.is_json else ()
    changes = itertools.chain.from_iterable(map(each_change_of_json, ordinary))
    for change in itertools.takewhile(lambda _: time.monotonic() < end_s, changes):
        one(change)
    left_s = max(1.0, end_s - time.monotonic())
    if is_guided:

        def mutate(data: bytes, most: int, seed: int) -> bytes:
            chance = random.Random(seed)
            if chance.random() < 0.3:
                return bytes(atheris.Mutate(data, most))
            base = [data] if data and chance.random() < 0.7 else seeds
            return changed(base, target.mutate, chance)[:most]

        corpus = folder / "corpus"
        corpus.mkdir()
        for place, data in enumerate(seeds):
            (corpus / str(place)).write_bytes(data)
        limits = [f"-max_total_time={int(left_s)}", "-rss_limit_mb=0"]
        limits += ["-max_len=262144", "-timeout=0", f"-seed={options.seed}", "-verbosity=0"]
        limits += [f"-artifact_prefix={folder}/"]
        atheris.Setup([sys.argv[0], *limits, str(corpus)], one, custom_mutator=mutate)
        with contextlib.suppress(SystemExit):
            atheris.Fuzz()
    else:
        chance = random.Random(options.seed)
        while time.monotonic() < end_s:
            one(changed(seeds, target.mutate, chance))
    _tell(tally, folder)
    return 0


def _tell(tally: Tally, folder: Path) -> None:
    part = folder / ".tally"
    part.write_text(json.dumps(asdict(tally)))
    part.replace(folder / "tally")


def _limit_memory() -> None:
    words = Path("/proc/self/statm").read_text().split()
    most = int(words[0]) * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


# ---------------------------------------------------------------------- the table


def table(tallies: Mapping[str, Tally]) -> str:
    """Markdown: for each target what it feeds, the inputs, the time, and what was found."""
    rows = [
        f"| `{name}` | {tally.executions:,} | {tally.seconds / 60:.1f} | {_found(tally)} |"
        for name, tally in tallies.items()
    ]
    whole = Tally(
        sum(each.executions for each in tallies.values()),
        sum(each.seconds for each in tallies.values()),
    )
    rows.append(f"| all | {whole.executions:,} | {whole.seconds / 60:.1f} | |")
    return "| target | inputs | minutes | findings |\n| --- | ---: | ---: | --- |\n" + "\n".join(
        rows
    )


def _found(tally: Tally) -> str:
    return "; ".join(f"**{text}**" for text in tally.findings.values()) or "0"


def _write(file: Path, text: str) -> None:
    """Write a table into a file, between the marks of what is generated."""
    before, begin, rest = file.read_text("utf-8").partition("<!-- generated: begin -->\n")
    _, end, after = rest.partition("<!-- generated: end -->")
    file.write_text(f"{before}{begin}\n{text}\n\n{end}{after}", "utf-8")


def _names() -> Sequence[str]:
    from .targets import TARGETS

    return [*TARGETS]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.fuzz", description=__doc__)
    add = parser.add_argument
    add("--hours", type=float, default=0.1, help="in all, shared by the targets (0.1)")
    add("--target", action="append", metavar="NAME", help="repeatable; see tests/fuzz/targets.py")
    add("--keep", type=Path, metavar="DIR", help="keep what was found there")
    add("--seed", type=int, default=1, help="of chance (1)")
    add("--by-chance", dest="guided", action="store_false", help="without atheris")
    add("--table", type=Path, metavar="FILE", help="write a table in Markdown, between its marks")
    add("--child", metavar="DIR", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
