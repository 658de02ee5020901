"""Python of each container: chosen among those of this machine, or made before anything starts.

On the launcher's own version of Python an environment is a layer: its site-packages have what the
container asks for and this environment has not, and everything else is found in this environment.
On another version of Python it has everything, ROS 2 included.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from neuros.backends.containers import ContainerFolder, find_container
from neuros.backends.environments.cache import Entry, cache_folder, sweep
from neuros.backends.environments.requirements import Requirements, read_requirements, unmet
from neuros.caching import KEY_LENGTH
from neuros.distribution import PACKAGE, install_command
from neuros.errors import EnvironmentFault
from neuros.installation.machine import (
    NEWEST,
    OLDEST,
    clean_environment,
    dotted,
    system_install,
)
from neuros.installation.packages import explain_machine, find_uv, run_installs
from neuros.installation.progress import Progress
from neuros.project.model import Node

Version = tuple[int, int]
FILE = ".python-version"
_VERSION = re.compile(r"(?:c?python-?)?(\d+)\.(\d+)(?:\.\d+)*")
_ASK = "import sys; print(sys.implementation.name, *sys.version_info[:2])"
_ANSWER_TIMEOUT_S = 10.0
HERE: Version = sys.version_info[:2]
_FORMAT = 1  # of what is made: another one makes all environments anew
_FULL_BYTES = 0.6e9  # ROS 2, and pip's copies while it works
_BOOTSTRAPPER = "ros_wheels_bootstrapper"
_NONE = re.compile(r"satisfies the requirement (.+?) \(from versions: (.*)\)")
_CONFLICT = re.compile(r"The conflict is caused by:\n((?: {4}.+\n)+)")
_FEW = 5


def wanted_version(folder: Path) -> Version | None:
    """The version in a container's ``.python-version``, as pyenv and uv read it; or ``None``.

    Raises:
        EnvironmentFault: if there are no packages of ROS 2 for that Python.
    """
    file = folder / FILE
    try:
        rows = [row.strip() for row in file.read_text("utf-8").splitlines()]
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{file} cannot be read: {error}") from error
    text = next((row for row in rows if row and not row.startswith("#")), "")
    match = _VERSION.fullmatch(text)
    version = (int(match[1]), int(match[2])) if match else (0, 0)
    if not OLDEST <= version <= NEWEST:
        raise EnvironmentFault(
            f"{file} asks for Python {text!r}: name a version that ROS 2 has packages for,"
            f" {dotted(OLDEST)} to {dotted(NEWEST)}"
        )
    return version


def find_python(version: Version, environ: Mapping[str, str]) -> Path | None:
    """A CPython of that version on this machine that runs, or ``None``."""
    for path in _candidates(f"python{dotted(version)}", environ):
        if os.access(path, os.X_OK) and _is_version(path, version, environ):
            return path
    return None


def _candidates(name: str, environ: Mapping[str, str]) -> Iterator[Path]:
    for folder in environ.get("PATH", os.defpath).split(os.pathsep):
        if folder:
            yield Path(folder) / name
    # A shim of pyenv is on the path, and refuses what its settings do not name.
    home = Path(environ.get("HOME") or "/")
    pyenv = Path(environ.get("PYENV_ROOT") or home / ".pyenv") / "versions"
    data = Path(environ.get("XDG_DATA_HOME") or home / ".local/share")
    uv = Path(environ.get("UV_PYTHON_INSTALL_DIR") or data / "uv/python")
    for installations in (pyenv, uv):
        yield from sorted(installations.glob(f"*/bin/{name}"), reverse=True)


def _is_version(path: Path, version: Version, environ: Mapping[str, str]) -> bool:
    try:
        answer = subprocess.run(
            [str(path), "-I", "-S", "-c", _ASK],
            env=clean_environment(environ),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_ANSWER_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return answer.stdout.split() == ["cpython", *map(str, version)]


@dataclass(frozen=True)
class Choice:
    """The Python and the packages of a container.

    Attributes:
        version: the Python that it is to run on.
        entry: its place in the cache.
        lacks: what this environment lacks, in words, as far as that had to be found out.
        base: the interpreter to make its environment with; ``None`` if nothing is to be made.
        notice: what the user should know, or empty.
    """

    container: ContainerFolder
    requirements: Requirements
    version: Version
    entry: Entry
    lacks: tuple[str, ...] = ()
    base: Path | None = None
    notice: str = ""

    @property
    def is_layered(self) -> bool:
        """Whether its environment lies on top of this one, and has only what differs."""
        return self.version == HERE

    @property
    def path(self) -> Path:
        """Its Python, which may have to be made first."""
        if self.base is not None:
            return self.entry.future_python
        return self.entry.python() or Path(sys.executable)

    def settle(self) -> None:
        """Remember for later starts that it is in use, or that this very Python does.

        Raises ``OSError``.
        """
        if self.base is not None:
            return
        if self.entry.python() is None:
            self.entry.settle(is_here=True)
        self.entry.note_use()


def choose(container: ContainerFolder, cache: Path, environ: Mapping[str, str]) -> Choice:
    """Choose for a container with a ``requirements.txt``.

    Raises:
        EnvironmentFault: if its files cannot be read, or ask for a Python without ROS 2.
    """
    wanted = wanted_version(container.folder)
    if wanted is None or wanted == HERE:
        return choose_here(container, cache)
    requirements = read_requirements(container.requirements)
    entry = _entry(container, requirements, cache, wanted)
    if entry.python():
        return Choice(container, requirements, wanted, entry)
    if base := find_python(wanted, environ):
        return Choice(container, requirements, wanted, entry, base=base)
    notice = (
        f"container '{container.name}' prefers Python {dotted(wanted)} ({container.folder / FILE}),"
        f" which is not on this machine: it gets Python {dotted(HERE)}"
    )
    return replace(choose_here(container, cache), notice=notice)


def choose_here(container: ContainerFolder, cache: Path) -> Choice:
    """Choose for a container that runs on this version of Python.

    Raises:
        EnvironmentFault: if its files cannot be read.
    """
    requirements = read_requirements(container.requirements)
    entry = _entry(container, requirements, cache, HERE)
    if entry.python():
        return Choice(container, requirements, HERE, entry)
    # The files of NeuROS's own containers say with exact versions what goes into images; which
    # versions are here is up to what has installed NeuROS.
    lacks = tuple(unmet(requirements, any_version=container.is_own))
    base = Path(getattr(sys, "_base_executable", sys.executable)) if lacks else None
    return Choice(container, requirements, HERE, entry, lacks, base)


def own_needs() -> list[str]:
    """The requirements of NeuROS itself; empty if it is not installed here."""
    try:
        needs = importlib.metadata.requires("neuros") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [need for need in needs if "extra ==" not in need]


def packages_here() -> list[Path]:
    """The folders of this Python with installed packages, those that are found first first."""
    return [Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]


def _entry(
    container: ContainerFolder, requirements: Requirements, cache: Path, version: Version
) -> Entry:
    what = [_FORMAT, container.is_own, requirements.digest, version, str(PACKAGE), own_needs()]
    if version == HERE:
        what += [sys.executable, sys.version, _installed_here()]
    key = hashlib.sha256(json.dumps(what).encode()).hexdigest()
    return Entry(cache / f"{container.name}-{key[:KEY_LENGTH]}")


def _installed_here() -> list[str]:
    """Names and versions of what is installed, from the names of folders only: it has to be quick.

    An environment on top of this one is no longer the same when anything here changes.
    """
    return [
        f"{folder}/{name}"
        for folder in packages_here()
        if folder.is_dir()
        for name in sorted(os.listdir(folder))
        if name.endswith((".dist-info", ".egg-info"))
    ]


class Pythons:
    """Pythons of the nodes whose containers have a ``requirements.txt``.

    Args:
        choices: by the name of the node; nodes of one container share theirs.
    """

    def __init__(self, choices: Mapping[str, Choice]) -> None:
        self._choices = choices

    @classmethod
    def choose(cls, nodes: Sequence[Node], project: Path, environ: Mapping[str, str]) -> Pythons:
        """Decide for the nodes of a project in the folder ``project``; changes nothing.

        Raises:
            EnvironmentFault: with all that is wrong in the folders of containers.
        """
        cache, faults = cache_folder(environ), []
        choices: dict[str, Choice] = {}
        for container, names in _containers(nodes, project):
            try:
                choices |= dict.fromkeys(names, choose(container, cache, environ))
            except EnvironmentFault as fault:
                faults.append(str(fault))
        if faults:
            raise EnvironmentFault("\n".join(faults))
        return cls(choices)

    @property
    def paths(self) -> Mapping[str, Path]:
        """The Python of each node that does not run on this very one."""
        pythons = {name: choice.path for name, choice in self._choices.items()}
        return {name: path for name, path in pythons.items() if path != Path(sys.executable)}

    @property
    def notices(self) -> list[str]:
        """Notices for the user."""
        return [choice.notice for choice in self._each() if choice.notice]

    @property
    def is_made(self) -> bool:
        """Whether everything is there."""
        return not any(choice.base for choice in self._each())

    def note_use(self) -> None:
        """Remember what was found out, as far as the cache can be written to."""
        for choice in self._each():
            with contextlib.suppress(OSError):
                choice.settle()

    def make(self, progress: Progress, run_environment: Mapping[str, str]) -> None:
        """Make what is missing; ``run_environment`` is added to that of the programs it starts.

        Raises:
            EnvironmentFault: with a sentence for each container for which that failed.
        """
        faults = []
        for choice in self._each():
            if choice.base is None:
                continue
            try:
                make(choice, progress, run_environment)
                sweep(choice.entry.folder.parent)
            except EnvironmentFault as fault:
                faults.append(str(fault))
        if faults:
            raise EnvironmentFault("\n".join(faults))

    def describe(self) -> list[str]:
        """One line per container that gets a Python of its own."""
        return [
            f"container {choice.container.name}: Python {dotted(choice.version)}, an environment"
            f" {'that launching makes first' if choice.base else 'of its own'}:"
            f" {choice.entry.folder}"
            for choice in self._each()
            if choice.path != Path(sys.executable)
        ]

    def _each(self) -> Iterable[Choice]:
        return {id(choice): choice for choice in self._choices.values()}.values()


def require_one_python(nodes: Sequence[Node], project: Path, environ: Mapping[str, str]) -> None:
    """Check that this very Python does for all nodes, as it must where they share a process.

    Raises:
        EnvironmentFault: with what is missing, and the ways out.
    """
    problems = []
    for container, names in _containers(nodes, project):
        choice = choose_here(container, cache_folder(environ))
        if choice.path == Path(sys.executable):
            with contextlib.suppress(OSError):
                choice.settle()
            continue
        which = f"node{'' if len(names) == 1 else 's'} {', '.join(names)}"
        lacks = choice.lacks or unmet(choice.requirements, any_version=container.is_own)
        problems.append(f"container '{container.name}' ({which}) needs {', '.join(lacks)}")
    if problems:
        raise EnvironmentFault(
            f"{'; '.join(problems)}: in one process all nodes share one Python; use --backend"
            f" process, or install that for {sys.executable}"
        )


def _containers(
    nodes: Sequence[Node], project: Path
) -> Iterator[tuple[ContainerFolder, Sequence[str]]]:
    """The containers that have a ``requirements.txt``, and the names of their nodes."""
    names: dict[str, list[str]] = {}
    for node in nodes:
        names.setdefault(node.container, []).append(node.name)
    for name, of_nodes in names.items():
        container = find_container(name, project)
        if container and container.requirements.is_file():
            yield container, of_nodes


def make(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    """Make the environment, unless another launch has made it meanwhile.

    Args:
        run_environment: is added to the environment of the programs that this starts.

    Raises:
        EnvironmentFault: with a sentence for the user; then nothing of it is left but the log.
    """
    try:
        choice.entry.folder.parent.mkdir(parents=True, exist_ok=True)
        with choice.entry.locked(wait=False) as is_mine:
            if is_mine:
                return _make(choice, progress, run_environment)
        progress.step(f"waiting for another launch that makes {_words(choice)}")
        with choice.entry.locked():
            _make(choice, progress, run_environment)
    except OSError as error:
        raise _fault(choice, why_no_files(error, choice.entry.folder.parent)) from error


def _make(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    """Make it, under the lock."""
    entry = choice.entry
    if entry.python():
        return
    entry.remove()  # what an interrupted run has left
    try:
        _make_venv(choice, progress, run_environment)
        _add_links(choice)
        _install(choice, progress, run_environment)
        entry.settle(is_here=False)
    except BaseException:
        entry.remove()
        raise


def _make_venv(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    folder, because = choice.entry.folder, f" ({', '.join(choice.lacks)})" if choice.lacks else ""
    progress.step(f"making {_words(choice)}{because}: {folder}")
    free_bytes = shutil.disk_usage(folder.parent).free
    if not choice.is_layered and free_bytes < _FULL_BYTES:
        raise _fault(
            choice,
            f"{folder.parent} has {free_bytes / 1e9:.1f} GB free and a whole environment needs"
            f" {_FULL_BYTES / 1e9:.1f} GB: make room (df -h), or set XDG_CACHE_HOME",
        )
    # A layer finds pip where it finds the rest.
    options = ["--without-pip"] if choice.is_layered and _is_here("pip") else []
    made = subprocess.run(
        [str(choice.base), "-m", "venv", *options, str(folder)],
        env={**clean_environment(os.environ), **run_environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode:
        output = (made.stdout + made.stderr).strip()
        raise _fault(choice, why_no_venv(output, dotted(choice.version)))


def _add_links(choice: Choice) -> None:
    """Give it this NeuROS, and, if it is a layer, what is here."""
    folder = choice.entry.folder
    site_packages = folder / "lib" / f"python{dotted(choice.version)}" / "site-packages"
    (site_packages / "neuros").symlink_to(PACKAGE, target_is_directory=True)
    if choice.is_layered:
        rows = [str(path) for path in packages_here()]
        if _is_here(_BOOTSTRAPPER):
            _link_libraries(folder, site_packages)
            rows.append(f"import {_BOOTSTRAPPER}")
        # Lines of a .pth file come behind what is in the environment itself.
        layer = "".join(f"{row}\n" for row in rows)
        (site_packages / "neuros_layer.pth").write_text(layer, "utf-8")


def _link_libraries(folder: Path, site_packages: Path) -> None:
    """The wheels of ROS 2 look for their libraries and files below the prefix of their Python."""
    prefix = Path(sys.prefix)
    libraries = [path for path in (prefix / "lib").iterdir() if not path.name.startswith("python")]
    for path in (*libraries, prefix / "share"):
        link = folder / path.relative_to(prefix)
        if path.exists() and not link.exists():
            link.symlink_to(path)
    for path in (path for here in packages_here() for path in here.glob("ros_*.libs")):
        (site_packages / path.name).symlink_to(path)


def _is_here(package: str) -> bool:
    return any((folder / package).is_dir() for folder in packages_here())


def _install(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    entry, needs = choice.entry, own_needs()
    wanted = ["--requirement", str(choice.requirements.file)]
    # With hashes, pip refuses what has none: then what NeuROS needs comes first, by itself.
    calls = [[*wanted, *needs]]
    if choice.requirements.has_hashes:
        calls = [needs, ["--require-hashes", *wanted]]
    if not needs:
        cause = f"neuros itself is not installed for {sys.executable}: {install_command()}"
        raise _fault(choice, cause)
    progress.step(f"installing {choice.requirements.file} (log: {entry.log})")
    environ = {**clean_environment(os.environ), **run_environment}
    # uv does not see what a layer finds in this environment, and would install all of it again.
    uv = None if choice.is_layered else find_uv(Path(sys.executable), environ)
    entry.log.unlink(missing_ok=True)
    output = run_installs(
        entry.future_python, uv, calls, entry.folder, entry.log, progress, environ
    )
    if output is not None:
        cause = why_pip_failed(output, dotted(choice.version), needs)
        raise _fault(choice, f"{cause} (log: {entry.log})")


def _words(choice: Choice) -> str:
    name = choice.container.name
    return f"the environment of container '{name}', Python {dotted(choice.version)}"


def _fault(choice: Choice, cause: str) -> EnvironmentFault:
    return EnvironmentFault(
        f"container '{choice.container.name}': {choice.requirements.file} is not satisfied here,"
        f" and its environment cannot be made: {cause}"
    )


def why_pip_failed(output: str, python: str, own_needs: Sequence[str]) -> str:
    """The cause in the output of pip, for a version of Python as ``3.12``.

    ``own_needs`` are the requirements of NeuROS itself that pip was given, too.
    """
    if sentence := explain_machine(output, again="launch"):
        return sentence
    if none := _NONE.search(output):
        return f"no {none[1]} exists for Python {python} ({_there_is(none[2].split(', '))})"
    if conflict := _CONFLICT.search(output):
        rows = "; ".join(row.strip() for row in conflict[1].splitlines())
        own = [need for need in own_needs if re.search(rf"\b{_name_of(need)}\b", rows)]
        return f"these exclude each other: {rows}" + "".join(f"; NeuROS needs {n}" for n in own)
    errors = re.findall(r"^ERROR: (.+)", output, re.MULTILINE)
    return errors[0] if errors else "pip failed"


def why_no_venv(output: str, python: str) -> str:
    """The cause in the output of ``venv``."""
    if re.search(r"ensurepip|No module named '?venv", output):
        remedy = system_install(apt=f"python{python}-venv", dnf="python3-pip")
        return f"Python {python} has no venv: {remedy}"
    rows = output.splitlines() or ["venv failed"]
    return explain_machine(output) or rows[-1]


def why_no_files(error: OSError, cache: Path) -> str:
    """The cause in an error of the cache's folder."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk of {cache} is full: make room (df -h), or set XDG_CACHE_HOME"
    return f"{error.filename or cache}: {error.strerror}: set XDG_CACHE_HOME to another folder"


def _there_is(versions: Sequence[str]) -> str:
    if list(versions) == ["none"]:
        return "pip finds no package of that name"
    more = "..., " if len(versions) > _FEW else ""
    return f"there is {more}{', '.join(versions[-_FEW:])}"


def _name_of(requirement: str) -> str:
    match = re.match(r"[\w.-]+", requirement)
    return re.escape(match[0]) if match else ""
