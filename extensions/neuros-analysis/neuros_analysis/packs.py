"""Packs: a run with all that repeats it in one file, which ``neuros verify`` runs again.

A pack is a zip file and an RO-Crate (https://w3id.org/ro/crate/1.1, of the profile
https://w3id.org/ro/wfrun/process/0.5)::

    ro-crate-metadata.json    what is in it, with the SHA-256 of every file
    project/                  the folder of the project: plugins, models, weights, messages
    run/                      the run folder: results, seeds, digests of all packets, run.json
    timing.json               the measured times of a run in virtual time that had some
    lib/                      NeuROS and its extensions
    requirements.txt          the other packages that NeuROS and its nodes need, with versions
    wheels/                   these packages, with ``--with-wheels``
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.distribution import libraries, python_command
from neuros.errors import EnvironmentFault, ProjectError, UsageError
from neuros.ordinary_files import digest_of

if TYPE_CHECKING:
    from neuros.project.model import Project

METADATA = "ro-crate-metadata.json"
_CRATE, _PROFILE = "https://w3id.org/ro/crate/1.1", "https://w3id.org/ro/wfrun/process/0.5"
_REQUIREMENTS, _WHEELS, _TIMING = "requirements.txt", "wheels", "timing.json"
_LONG_BYTES = 1 << 40
"""A file that claims to unpack to more is no pack."""


def pack(run: str | os.PathLike[str], file: str | os.PathLike[str], *, wheels: bool) -> list[str]:
    """Write the pack of a run; returns reasons why the project may do something else again.

    Args:
        run: its folder.
        file: the new file.
        wheels: whether to add the packages, for machines without a network.

    Raises:
        UsageError: there is no such run, or it cannot be started again from its project file.
        ProjectError: the folder of the project has files that cannot be copied.
        EnvironmentFault: the file cannot be written, or pip cannot fetch a package.
    """
    from neuros.api.project import StartOptions
    from neuros.api.run_record import open_run
    from neuros.project.files_to_copy import files_to_copy
    from neuros.project.repeatable import why_not_repeatable
    from neuros_analysis.forking import repeated, why_not_repeated

    folder, target = Path(run).absolute(), Path(file).absolute()
    if target.exists():
        raise UsageError(f"-o {file}: exists already: name a new file")
    record = open_run(folder).record
    project, given = repeated(record, folder, {})
    described = project.described(StartOptions(**given))
    if why := [*why_not_repeated(described, record, given)]:
        raise UsageError("\n".join([f"{folder} cannot be packed:", *(f"  {each}" for each in why)]))
    found, problems = files_to_copy(described.folder, target)
    if problems:
        raise ProjectError(problems)
    left_out = shutil.ignore_patterns("__pycache__", ".*", "*.sock", "examples")
    try:
        with tempfile.TemporaryDirectory(prefix="neuros-pack-") as temporary:
            draft = Path(temporary, "pack")
            shutil.copytree(
                described.folder,
                draft / "project",
                ignore=lambda at, names: [name for name in names if Path(at, name) not in found],
            )
            shutil.copytree(folder, draft / "run", ignore=left_out)
            # A checkout in which a wheel was built has a neuros.egg-info that comes first.
            metadata = next(
                place
                for own in importlib.metadata.distributions(name="neuros")
                if (place := Path(str(own.locate_file(f"neuros-{own.version}.dist-info")))).is_dir()
            )
            for name, place in {**libraries(), metadata.name: metadata}.items():
                shutil.copytree(place, draft / "lib" / name, ignore=left_out)
            if timing := given.get("timing"):
                shutil.copyfile(timing, draft / _TIMING)
            text = "".join(f"{name}=={version}\n" for name, version in _locked(record, described))
            (draft / _REQUIREMENTS).write_text(text, "utf-8")
            if wheels:
                _fetch(draft)
            (draft / METADATA).write_text(json.dumps(_metadata(draft, record), indent=2), "utf-8")
            made = shutil.make_archive(str(draft), "zip", draft)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(made, target)
    except OSError as error:
        raise EnvironmentFault(f"{target} cannot be written: {error}") from error
    return why_not_repeatable(described)


def _locked(record: Mapping[str, Any], project: Project) -> list[tuple[str, str]]:
    """Packages that NeuROS, its extensions and the containers of the nodes need, with versions.

    Versions are those of the run. A package of which it had none is left out: another system or
    another Python needs it.
    """
    from packaging.requirements import InvalidRequirement, Requirement

    from neuros.backends.containers import find_container
    from neuros.backends.pythons import read_requirements

    versions = record["versions"]
    had = {_plain(name): version for name, version in versions["packages"].items()}
    for node in versions["nodes"].values():
        had = {**{_plain(name): version for name, version in node["packages"].items()}, **had}
    own = [name for name in had if re.fullmatch(r"neuros(-\w+)?", name)]
    pending = [*own, "uv"]  # which installs the others
    for name in dict.fromkeys(node.container for node in project.nodes):
        container = find_container(name, project.folder)
        if container is not None and container.requirements.is_file():
            pending += [line.text for line in read_requirements(container.requirements).lines]
    found: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    while pending:
        try:
            wanted = Requirement(pending.pop())
        except InvalidRequirement:  # an option of pip
            continue
        name = _plain(wanted.name)
        for extra in {"", *wanted.extras} - {extra for known, extra in seen if known == name}:
            seen.add((name, extra))
            if name in had and name not in own:
                found[name] = had[name]
            try:
                needs = importlib.metadata.requires(name) or []
            except importlib.metadata.PackageNotFoundError:
                continue
            for text in needs:
                need = Requirement(text)
                if need.marker is None or need.marker.evaluate({"extra": extra}):
                    pending.append(f"{need.name}[{','.join(need.extras)}]")
    return sorted(found.items())


def _plain(name: str) -> str:
    """The name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _fetch(draft: Path) -> None:
    """Fetch the packages as wheels. Raises ``EnvironmentFault``."""
    arguments = ("pip", "wheel", "--no-deps", "--disable-pip-version-check", "--quiet")
    places = ("--wheel-dir", str(draft / _WHEELS), "--requirement", str(draft / _REQUIREMENTS))
    done = subprocess.run(
        python_command(*arguments, *places), capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["pip does not say why"])[-1]
        raise EnvironmentFault(f"--with-wheels: pip cannot fetch all packages: {last}")


def _metadata(draft: Path, record: Mapping[str, Any]) -> dict[str, Any]:
    """The content of ``ro-crate-metadata.json``."""
    files = sorted(path for path in draft.rglob("*") if path.is_file())
    names = [path.relative_to(draft).as_posix() for path in files]
    project = f"project/{Path(record['file']).name}"
    began = datetime.fromtimestamp(record["started"], timezone.utc)
    ended = datetime.fromtimestamp(record["started"] + record["wall_s"], timezone.utc)
    description = record["expanded_project"].get("description") or record["reason"]
    versions, machine = record["versions"], record["machine"]
    return {
        "@context": f"{_CRATE}/context",
        "@graph": [
            {
                "@id": METADATA,
                "@type": "CreativeWork",
                "conformsTo": {"@id": _CRATE},
                "about": {"@id": "./"},
            },
            {
                "@id": "./",
                "@type": "Dataset",
                "name": f"{record['project']}: a run of NeuROS",
                "description": description,
                "datePublished": datetime.now(timezone.utc).date().isoformat(),
                "license": "The licences of the project and of its packages hold",
                "conformsTo": {"@id": _PROFILE},
                "hasPart": [{"@id": name} for name in names],
                "mentions": {"@id": "#run"},
            },
            {
                "@id": _PROFILE,
                "@type": "CreativeWork",
                "name": "Process Run Crate",
                "version": "0.5",
            },
            {
                "@id": "#run",
                "@type": "CreateAction",
                "name": f"Run {record.get('run_id', '')}: {record['reason']}",
                "instrument": {"@id": "#neuros"},
                "object": {"@id": project},
                "result": {"@id": "run/run.json"},
                "startTime": began.isoformat(timespec="milliseconds"),
                "endTime": ended.isoformat(timespec="milliseconds"),
                "actionStatus": {
                    "@id": "http://schema.org/"
                    + ("FailedActionStatus" if record["exit_code"] else "CompletedActionStatus")
                },
                "description": f"{' '.join(record['command'])} on {machine['system']},"
                f" {machine['processor']}, Python {versions['python']}",
            },
            {
                "@id": "#neuros",
                "@type": "SoftwareApplication",
                "name": "NeuROS",
                "version": versions["neuros"],
                "url": "https://github.com/LeePerry/NeuROS",
            },
            *(
                {
                    "@id": name,
                    "@type": "File",
                    "name": Path(name).name,
                    "contentSize": str(path.stat().st_size),
                    "sha256": digest_of(path),
                }
                for name, path in zip(names, files, strict=True)
            ),
        ],
    }


def run_again(file: Path, folder: Path) -> tuple[Path, Path]:
    """Unpack a pack, make its environment, and run its project; returns both run folders.

    Args:
        folder: a new folder for all that.

    Raises:
        UsageError: the file is no pack, or is damaged.
        EnvironmentFault: its Python or its packages are not to be had here, or nothing ran.
    """
    from neuros.api.run_record import open_run

    _unpack(file, folder)
    record = open_run(folder / "run").record
    python = _environment(folder, record["versions"]["python"])
    environment = _surroundings(folder) | {"PYTHONPATH": str(folder / "lib")}
    command = python_command(__name__, str(folder), python=python)
    done = subprocess.run(command, env=environment, stdout=2, check=False)
    if not (folder / "again" / "run.json").is_file():
        raise EnvironmentFault(
            f"{file}: the run could not be started again (exit code {done.returncode})"
        )
    return folder / "run", folder / "again"


def _unpack(file: Path, folder: Path) -> None:
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(each.file_size for each in archive.infolist()) > _LONG_BYTES:
                raise zipfile.BadZipFile("it claims to be larger than any pack")
            archive.extractall(folder)
        graph = json.loads((folder / METADATA).read_text("utf-8"))["@graph"]
        known = {each["@id"]: each["sha256"] for each in graph if "sha256" in each}
        changed = [name for name in known if digest_of(folder / name) != known[name]]
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise UsageError(
            f"{file}: is not what `neuros pack` writes: {type(error).__name__}: {error}"
        ) from error
    unknown = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    if wrong := sorted({*changed, *(unknown - known.keys() - {METADATA})}):
        raise UsageError(f"{file}: was changed after it was packed: {', '.join(wrong[:5])}")


def _environment(folder: Path, version: str) -> Path:
    """Make the environment of the pack; returns its Python. Raises ``EnvironmentFault``."""
    from neuros.backends.pythons import find_python
    from neuros.installation.packages import InstallationFailed, Installer
    from neuros.installation.progress import Progress

    major, minor, *_ = version.split(".")
    base = find_python((int(major), int(minor)), os.environ)
    if base is None:
        raise EnvironmentFault(f"the run had Python {version}: install Python {major}.{minor} here")
    progress, place = Progress(sys.stderr), folder / "environment"
    progress.step(f"making an environment of Python {major}.{minor} with the packages of the run")
    python, log = place / "bin" / "python", folder / "environment.log"
    installer = Installer(python, folder, log, progress, _surroundings(folder))
    try:
        installer.make_environment(base)
        installer.install(["--no-deps", "--requirement", str(folder / _REQUIREMENTS)])
    except InstallationFailed as failure:
        rows = failure.output.strip().splitlines() or ["uv does not say why"]
        raise EnvironmentFault(
            f"the packages of the run cannot be installed: {rows[-1].strip()} (log: {log}); a pack"
            " that was made with --with-wheels needs no network"
        ) from failure
    return python


def _surroundings(folder: Path) -> dict[str, str]:
    """The environment of what runs for a pack: installs come from its wheels, if it has them."""
    from neuros.installation.machine import clean_environment

    environment = clean_environment(os.environ)
    if (folder / _WHEELS).is_dir():
        environment |= {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(folder / _WHEELS)}
    return environment


def _main() -> None:
    """Run the project of the unpacked pack in a folder; in the environment of the pack."""
    from neuros.api.run_record import open_run
    from neuros_analysis.forking import repeated

    folder = Path(sys.argv[1])
    record = open_run(folder / "run").record
    file = folder / "project" / Path(record["file"]).name
    timing = folder / _TIMING
    options = {
        "output": folder / "again",
        "backend": record["backend"],
        "timing": timing if timing.is_file() else None,
        "show": True,
    }
    project, given = repeated({**record, "file": str(file)}, folder / "run", options)
    project.run(**given)


def add_pack(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write a run with its project, its packages and NeuROS into one file, an RO-Crate."
        " `neuros verify FILE` unpacks it, runs the project again and compares all packets."
    )
    add = parser.add_argument
    add("run", metavar="RUN", help="a run folder")
    add("-o", "--output", metavar="FILE", help="a new file (default: RUN.crate.zip here)")
    add(
        "--with-wheels",
        action="store_true",
        help="add the packages, so that `neuros verify` needs no network",
    )
    parser.set_defaults(command=_pack)


def _pack(options: argparse.Namespace) -> int:
    file = Path(options.output or f"{Path(options.run).absolute().name}.crate.zip")
    reasons = pack(options.run, file, wheels=options.with_wheels)
    for reason in reasons:
        print(f"note: it may do something else again: {reason}")
    print(f"{file}: {file.stat().st_size / 1e6:.1f} MB; neuros verify {file} runs it again")
    return 0


if __name__ == "__main__":
    _main()
