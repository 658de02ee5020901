"""Python of each container, for nodes that run as processes.

A node runs on this Python if this environment satisfies the ``requirements.txt`` of its container.
Every other container gets a virtual environment, made before anything starts. Choosing changes
nothing on the disk.

On the launcher's own version of Python an environment is a layer: its site-packages hold what the
container asks for and the launcher's environment lacks; all else is found in the launcher's.
On another version of Python it holds everything, ROS 2 included.

::

    ~/.cache/neuros/environments/     (or $XDG_CACHE_HOME/neuros/environments)
        <container>-<key>/            a virtual environment
        <container>-<key>.here        the launcher's own environment is enough; there is no folder
        <container>-<key>.lock        exists while a launch makes the environment
        <container>-<key>.log         output of uv

The file ``neuros-whole`` is written last into an environment, so an interrupted one never looks
whole. A ``.here`` saves the next start from reading the metadata of packages.

``requirements.txt`` is read as pip reads it, and compared with the installed packages. The format:
https://pip.pypa.io/en/stable/reference/requirements-file-format/
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
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from neuros.backends.containers import ContainerFolder, find_container
from neuros.caching import KEY_LENGTH, Kept, cache_root, sweep
from neuros.distribution import PACKAGE, install_command, libraries
from neuros.errors import EnvironmentFault
from neuros.installation.machine import NEWEST, OLDEST, answer_of, clean_environment, dotted
from neuros.installation.packages import (
    InstallationFailed,
    Installer,
    explain_machine,
    why_unsatisfiable,
)
from neuros.installation.progress import Progress
from neuros.project.model import Node

Version = tuple[int, int]
HERE: Version = sys.version_info[:2]
_FULL_BYTES = 0.6e9  # ROS 2, and uv's copies while it works
_BOOTSTRAPPER = "ros_wheels_bootstrapper"
_PLANNED = re.compile(r"^ \+ (.+)$", re.MULTILINE)


def cache_folder(environ: Mapping[str, str]) -> Path:
    return cache_root(environ) / "environments"


@dataclass(frozen=True)
class CachedEnvironment(Kept):
    """One environment, made or not; its log is the output of uv."""

    @property
    def mark(self) -> Path:
        """An empty file: the environment is whole, or the launcher's own Python is enough."""
        has_folder = os.path.exists(self.folder)  # exists() raises in a cache without rights
        return self.folder / "neuros-whole" if has_folder else self.beside(".here")

    @property
    def future_python(self) -> Path:
        """The Python in it, once it is made."""
        return self.folder / "bin" / "python"

    def python(self) -> Path | None:
        """The Python to run, or ``None`` without a mark."""
        python = self.future_python if os.path.exists(self.folder) else Path(sys.executable)
        return python if os.path.exists(self.mark) and os.access(python, os.X_OK) else None

    def record_use(self) -> None:
        """Write the mark, whose time is that of the last use. Raises ``OSError``."""
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        self.mark.touch()

    def remove(self) -> None:
        with contextlib.suppress(OSError):
            self.mark.unlink(missing_ok=True)
        super().remove()


@dataclass(frozen=True)
class Choice:
    """The Python and the packages of a container.

    Attributes:
        version: of its Python.
        entry: its place in the cache.
        lacks: requirements that this environment lacks, in words; empty where nobody had to look.
        base: the interpreter to make its environment with; ``None`` if nothing is to be made.
        notice: for the user, or empty.
    """

    container: ContainerFolder
    requirements: Requirements
    version: Version
    entry: CachedEnvironment
    lacks: tuple[str, ...] = ()
    base: Path | None = None
    notice: str = ""

    @property
    def is_layered(self) -> bool:
        """Whether its environment is a layer over this one."""
        return self.version == HERE

    @property
    def path(self) -> Path:
        """Its Python, which may not be made yet."""
        if self.base is not None:
            return self.entry.future_python
        return self.entry.python() or Path(sys.executable)

    def record_use(self) -> None:
        """Record for later starts that the environment, or this very Python, is used.

        Raises ``OSError``.
        """
        if self.base is None and (self.entry.python() or not os.path.exists(self.entry.folder)):
            self.entry.record_use()


def own_needs() -> list[str]:
    """The requirements of NeuROS itself; empty if NeuROS is not installed here."""
    try:
        needs = importlib.metadata.requires("neuros") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [need for need in needs if "extra ==" not in need]


def packages_here() -> list[Path]:
    """The folders of this Python with installed packages, in the order of ``sys.path``."""
    return [Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]


def make(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    """Make the environment, unless another launch has made it meanwhile.

    Args:
        run_environment: is added to the environment of pip, uv and venv.

    Raises:
        EnvironmentFault: with a sentence for the user; then only the log is left.
    """
    try:
        choice.entry.folder.parent.mkdir(parents=True, exist_ok=True)
        choice.entry.build(
            lambda: _make(choice, progress, run_environment),
            lambda: progress.step(f"waiting for another launch that makes {_words(choice)}"),
        )
    except OSError as error:
        raise _fault(choice, why_no_files(error, choice.entry.folder.parent)) from error


def _make(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    """Make the environment while its lock is held."""
    entry = choice.entry
    if entry.python():
        return
    entry.remove()  # an interrupted launch may have left a part
    because = f" ({', '.join(choice.lacks)})" if choice.lacks else ""
    progress.step(f"making {_words(choice)}{because}: {entry.folder}")
    free_bytes = shutil.disk_usage(entry.folder.parent).free
    if not choice.is_layered and free_bytes < _FULL_BYTES:
        raise _fault(
            choice,
            f"{entry.folder.parent} has {free_bytes / 1e9:.1f} GB free and a whole environment"
            f" needs {_FULL_BYTES / 1e9:.1f} GB: make room (df -h), or set XDG_CACHE_HOME",
        )
    needs, file = own_needs(), choice.requirements.file
    if not needs:
        cause = f"neuros itself is not installed for {sys.executable}: {install_command()}"
        raise _fault(choice, cause)
    progress.step(f"installing {file} (log: {entry.log})")
    environ = {**clean_environment(os.environ), **run_environment}
    entry.log.unlink(missing_ok=True)
    installer = Installer(entry.future_python, entry.folder.parent, entry.log, progress, environ)
    wanted = ["--requirement", str(file)]
    try:
        installer.make_environment(choice.base or Path(sys.executable))
        _add_links(choice)
        if any("--hash" in line.text for line in choice.requirements.lines):
            # uv refuses requirements without a hash, so those of NeuROS are installed first.
            if not choice.is_layered:
                installer.install(needs)
            wanted, needs = ["--require-hashes", *wanted], []
        elif choice.is_layered:
            # uv does not see this environment through the layer, so it plans for this environment.
            plan = ["--dry-run", "--break-system-packages", *wanted, *needs]
            planned = _PLANNED.findall(installer.install(plan, Path(sys.executable)))
            wanted, needs = ["--no-deps", *planned, *choice.requirements.editable], []
        installer.install([*wanted, *needs])
        entry.record_use()
    except BaseException as error:
        entry.remove()
        if not isinstance(error, InstallationFailed):
            raise
        cause = why_uv_failed(error.output, dotted(choice.version), needs)
        raise _fault(choice, f"{cause} (log: {entry.log})") from error


def _add_links(choice: Choice) -> None:
    """Link NeuROS and its extensions, and for a layer the packages of this environment."""
    folder = choice.entry.folder
    site_packages = folder / "lib" / f"python{dotted(choice.version)}" / "site-packages"
    for name, place in libraries().items():
        (site_packages / name).symlink_to(place, target_is_directory=True)
    if not choice.is_layered:
        return
    rows = [str(path) for path in packages_here()]
    if any((here / _BOOTSTRAPPER).is_dir() for here in packages_here()):
        rows.append(f"import {_BOOTSTRAPPER}")
        # The wheels of ROS 2 look for their libraries and files below the prefix of their Python.
        prefix = Path(sys.prefix)
        for path in (*(prefix / "lib").iterdir(), prefix / "share"):
            link = folder / path.relative_to(prefix)
            if not path.name.startswith("python") and path.exists() and not link.exists():
                link.symlink_to(path)
        for path in (path for here in packages_here() for path in here.glob("ros_*.libs")):
            (site_packages / path.name).symlink_to(path)
    # Python searches lines of a .pth file after the environment's own packages.
    (site_packages / "neuros_layer.pth").write_text("".join(f"{row}\n" for row in rows), "utf-8")


def _words(choice: Choice) -> str:
    name = choice.container.name
    return f"the environment of container '{name}', Python {dotted(choice.version)}"


def _fault(choice: Choice, cause: str) -> EnvironmentFault:
    return EnvironmentFault(
        f"container '{choice.container.name}': {choice.requirements.file} is not satisfied here,"
        f" and its environment cannot be made: {cause}"
    )


def why_uv_failed(output: str, python: str, own_needs: Sequence[str]) -> str:
    """The cause in the output of uv.

    Args:
        python: the version, as ``3.12``.
        own_needs: requirements of NeuROS itself among those that uv got.
    """
    if sentence := explain_machine(output, again="launch"):
        return sentence
    if cause := why_unsatisfiable(output):
        names = {need: re.split(r"[^\w.-]", need)[0] for need in own_needs}
        own = [need for need in own_needs if re.search(rf"\b{re.escape(names[need])}\b", cause)]
        return f"{cause} (for Python {python})" + "".join(f"; NeuROS needs {n}" for n in own)
    errors = re.findall(r"^(?:error|  cause): (.+)", output, re.MULTILINE)
    return ": ".join(errors) or "uv failed"


def why_no_files(error: OSError, cache: Path) -> str:
    """The cause in an error of the cache's folder."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk of {cache} is full: make room (df -h), or set XDG_CACHE_HOME"
    return f"{error.filename or cache}: {error.strerror}: set XDG_CACHE_HOME to another folder"


_COMMENT = re.compile(r"(^|\s+)#.*$")
_INCLUDE = re.compile(r"(-r|-c|--requirement|--constraint)(?:\s+|=|(?<=-[rc]))(?P<file>\S.*)")
_EDITABLE = re.compile(r"(?:-e|--editable)(?:\s+|=|(?<=-e))(\S.*)")
_OPTION = re.compile(r"\s--?\w.*$")


@dataclass(frozen=True)
class Line:
    """One requirement, or an option of pip.

    Attributes:
        is_constraint: whether it counts only if something else asks for the package.
    """

    text: str
    is_constraint: bool = False


@dataclass(frozen=True)
class Requirements:
    """A ``requirements.txt`` with all included files.

    Attributes:
        digest: of the contents of all.
    """

    file: Path
    lines: tuple[Line, ...]
    digest: str

    @property
    def editable(self) -> list[str]:
        """The arguments that install the editable requirements."""
        rows = [_EDITABLE.fullmatch(line.text) for line in self.lines]
        return [argument for row in rows if row for argument in ("--editable", row[1])]


def read_requirements(file: Path) -> Requirements:
    """Read a file and the files that it includes.

    Raises:
        EnvironmentFault: if a file cannot be read.
    """
    digest = hashlib.sha256()
    lines: list[Line] = []
    seen: set[tuple[Path, bool]] = set()

    def read(path: Path, is_constraint: bool) -> None:
        if (path.resolve(), is_constraint) in seen:
            return
        seen.add((path.resolve(), is_constraint))
        try:
            text = path.read_text("utf-8-sig")
        except OSError as error:
            raise EnvironmentFault(f"{path} cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise EnvironmentFault(f"{path} is not valid UTF-8: save it as UTF-8") from error
        digest.update(f"{is_constraint} {len(text)} {text}".encode())
        # A backslash at the end joins a line to the next.
        for line in re.sub(r"\\\r?\n", "", text).splitlines():
            row = _COMMENT.sub("", line).strip()
            include = _INCLUDE.fullmatch(row)
            if not row:
                continue
            if include and "://" not in include["file"]:
                read(path.parent / include["file"], is_constraint or "c" in include[1])
            else:
                lines.append(Line(row, is_constraint))

    read(file, False)
    return Requirements(file, tuple(lines), digest.hexdigest())


def unmet(requirements: Requirements, *, any_version: bool = False) -> list[str]:
    """Requirements that this environment lacks, in words; empty if it lacks none.

    Args:
        any_version: whether any installed version of a package is enough.
    """
    options = ("-e", "--editable")
    lines = [x for x in requirements.lines if x.text[:1] != "-" or x.text.startswith(options)]
    return list(dict.fromkeys(lack for line in lines for lack in _lacks(line, any_version)))


def _another_ros_has(name: str) -> bool:
    """Whether a ROS distribution that is sourced, or wheels of another one, have a package."""
    wheel = re.fullmatch(r"ros-[a-z]+-(.+)", name)
    if wheel is None:
        return False
    marker = Path("share/ament_index/resource_index/packages", wheel[1].replace("-", "_"))
    sourced = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    return any((Path(prefix) / marker).exists() for prefix in (*sourced, sys.prefix))


def _lacks(line: Line, any_version: bool) -> Iterator[str]:
    from packaging.requirements import InvalidRequirement, Requirement

    try:
        requirement = Requirement(_OPTION.sub("", line.text))
    except InvalidRequirement:  # a path, an address, or a mistake: uv tells
        yield line.text
        return
    pending, seen = [(requirement, "")], {""}
    while pending:
        wanted, extra = pending.pop()
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        text = str(wanted).partition(";")[0].strip()
        try:
            installed = importlib.metadata.distribution(wanted.name)
            version = installed.version
        except (importlib.metadata.PackageNotFoundError, FileNotFoundError, KeyError):
            version = ""
        if not version:  # or an interrupted pip has left a part of the package
            if not (line.is_constraint or (any_version and _another_ros_has(wanted.name))):
                yield f"{text} (not installed)"
            continue
        fits = any_version or wanted.specifier.contains(version, prereleases=True)
        if wanted.url and not any_version:
            origin = installed.read_text("direct_url.json")
            fits = origin is not None and json.loads(origin).get("url") == wanted.url
        if not fits:
            yield f"{text} ({version} is installed)"
            continue
        # What an extra adds is a requirement, too; other dependencies came with the package.
        for name in wanted.extras - seen:
            seen.add(name)
            needs = [Requirement(need) for need in installed.requires or () if "extra" in need]
            pending += [(need, name) for need in needs]


FILE = ".python-version"
_VERSION = re.compile(r"(?:c?python-?)?(\d+)\.(\d+)(?:\.\d+)*")
_ASK = "import sys; print(sys.implementation.name, *sys.version_info[:2])"
_ANSWER_TIMEOUT_S = 10.0
_FORMAT = 2  # of environments: another number makes all anew


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
    name = f"python{dotted(version)}"
    folders = environ.get("PATH", os.defpath).split(os.pathsep)
    candidates = [Path(folder) / name for folder in folders if folder]
    # A shim of pyenv on the path refuses versions that pyenv's settings do not name.
    home = Path(environ.get("HOME") or "/")
    pyenv = Path(environ.get("PYENV_ROOT") or home / ".pyenv") / "versions"
    data = Path(environ.get("XDG_DATA_HOME") or home / ".local/share")
    uv = Path(environ.get("UV_PYTHON_INSTALL_DIR") or data / "uv/python")
    for installations in (pyenv, uv):
        candidates += sorted(installations.glob(f"*/bin/{name}"), reverse=True)
    for path in candidates:
        if not os.access(path, os.X_OK):
            continue
        command = [str(path), "-I", "-S", "-c", _ASK]
        answer = answer_of(command, clean_environment(environ), _ANSWER_TIMEOUT_S)
        if answer and answer.stdout.split() == ["cpython", *map(str, version)]:
            return path
    return None


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
    # NeuROS's own containers name exact versions for their images; the versions here are those
    # of the installation.
    lacks = tuple(unmet(requirements, any_version=container.is_own))
    base = Path(getattr(sys, "_base_executable", sys.executable)) if lacks else None
    return Choice(container, requirements, HERE, entry, lacks, base)


def _entry(
    container: ContainerFolder, requirements: Requirements, cache: Path, version: Version
) -> CachedEnvironment:
    # An environment on top of this one is no longer the same when a package here changes. Names of
    # folders hold names and versions, and are quick to list.
    here = [
        f"{folder}/{name}"
        for folder in packages_here()
        if folder.is_dir()
        for name in sorted(os.listdir(folder))
        if name.endswith((".dist-info", ".egg-info"))
    ]
    parts = [_FORMAT, container.is_own, requirements.digest, version, str(PACKAGE), own_needs()]
    parts += [name for name in here if os.path.basename(name).startswith("neuros_")]  # extensions
    if version == HERE:
        parts += [sys.executable, sys.version, here]
    key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    return CachedEnvironment(cache / f"{container.name}-{key[:KEY_LENGTH]}")


class Pythons:
    """Pythons of the nodes whose containers have a ``requirements.txt``.

    Args:
        choices: by the name of the node; nodes of one container share theirs.
    """

    def __init__(self, choices: Mapping[str, Choice]) -> None:
        self._choices = choices

    @classmethod
    def choose(cls, nodes: Sequence[Node], project: Path, environ: Mapping[str, str]) -> Pythons:
        """Choose for the nodes of the project in the folder ``project``.

        Raises:
            EnvironmentFault: with all mistakes in the folders of containers.
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
        """The Python of each node that does not run on this Python."""
        pythons = {name: choice.path for name, choice in self._choices.items()}
        return {name: path for name, path in pythons.items() if path != Path(sys.executable)}

    @property
    def notices(self) -> list[str]:
        return [choice.notice for choice in self._each() if choice.notice]

    @property
    def is_made(self) -> bool:
        return not any(choice.base for choice in self._each())

    def record_use(self) -> None:
        """Record the use of each choice, where the cache can be written."""
        for choice in self._each():
            with contextlib.suppress(OSError):
                choice.record_use()

    def make(self, progress: Progress, run_environment: Mapping[str, str]) -> None:
        """Make missing environments; ``run_environment`` is added to that of pip, uv and venv.

        Raises:
            EnvironmentFault: with a sentence for each container for which that failed.
        """
        faults = []
        for choice in self._each():
            if choice.base is None:
                continue
            try:
                make(choice, progress, run_environment)
                sweep(choice.entry.folder.parent, CachedEnvironment)
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
    """Check that this Python satisfies all nodes, which share one process.

    Raises:
        EnvironmentFault: with the missing packages, and the remedies.
    """
    problems = []
    for container, names in _containers(nodes, project):
        choice = choose_here(container, cache_folder(environ))
        if choice.path == Path(sys.executable):
            with contextlib.suppress(OSError):
                choice.record_use()
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
