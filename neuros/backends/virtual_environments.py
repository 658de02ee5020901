"""Virtual environments of containers.

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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuros.backends.containers import ContainerFolder
from neuros.caching import Kept, cache_root
from neuros.distribution import install_command, libraries
from neuros.errors import EnvironmentFault
from neuros.installation.machine import clean_environment, dotted
from neuros.installation.packages import (
    InstallationFailed,
    Installer,
    explain_machine,
    why_unsatisfiable,
)
from neuros.installation.progress import Progress

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
        if choice.requirements.has_hashes:
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
    def has_hashes(self) -> bool:
        """Whether uv refuses packages without a hash."""
        return any("--hash" in line.text for line in self.lines)

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
