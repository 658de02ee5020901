"""ROS packages with messages: in a workspace, found as colcon finds them, and those of ROS."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuros.errors import Problem

MANIFEST = "package.xml"
KINDS = ("msg", "srv", "action")
"""The folders of interfaces, which are also the suffixes of the files in them."""

_LONGEST_NAME = 200
"""Names of files have at most 255 bytes: the name of a package, and up to 50 more."""

_USED = re.compile(rb"^([a-z][a-z0-9_]*)/[A-Z]\w*[\[ \t]", re.MULTILINE)
_BUILDS_INTERFACES = ("rosidl_interface_packages", "rosidl_default_generators")
"""Names in the manifest of a package whose interfaces ROS builds."""

_IGNORED = ("COLCON_IGNORE", "AMENT_IGNORE", "CATKIN_IGNORE")
_NOT_SOURCES = {"build", "install", "log"}


@dataclass(frozen=True)
class Package:
    """A package with interfaces.

    Attributes:
        folder: holds ``package.xml``.
        files: its interface files, relative to the folder: ``msg/Joints.msg``.
        declared: packages that the manifest names for building or running.
        used: packages whose messages its files use.
    """

    name: str
    folder: Path
    files: tuple[Path, ...]
    declared: frozenset[str]
    used: frozenset[str]

    @property
    def dependencies(self) -> frozenset[str]:
        """Packages that are built before it; ROS finds the used ones through the declared ones."""
        return self.declared | self.used

    @property
    def messages(self) -> set[str]:
        return {file.stem for file in self.files if file.suffix == ".msg"}

    @property
    def summary(self) -> str:
        """``2 messages, 1 service``."""
        words = {"msg": "message", "srv": "service", "action": "action"}
        counts = {
            word: sum(f.suffix == f".{kind}" for f in self.files) for kind, word in words.items()
        }
        return ", ".join(f"{n} {word}{'' if n == 1 else 's'}" for word, n in counts.items() if n)


def find_packages(workspace: Path) -> tuple[list[Package], list[Problem]]:
    """The packages with interfaces in a folder, and the mistakes in their manifests.

    Hidden folders, those with a ``COLCON_IGNORE``, and those that colcon makes are left out.
    """
    packages: list[Package] = []
    problems: list[Problem] = []
    for place, folders, names in os.walk(workspace):
        if any(name in names for name in _IGNORED):
            folders.clear()
            continue
        if MANIFEST not in names:
            folders[:] = sorted(f for f in folders if f[0] != "." and f not in _NOT_SOURCES)
            continue
        folders.clear()  # packages do not nest
        folder = Path(place)
        files = tuple(
            file.relative_to(folder)
            for kind in KINDS
            for file in sorted((folder / kind).glob(f"*.{kind}"))
        )
        others = [] if files else misplaced(folder)
        if not (files or others):
            continue
        try:
            package = _read(folder, files, others)
        except ManifestError as error:
            problems.append(error.problem)
            continue
        if package is None:
            continue
        twin = next((other for other in packages if other.name == package.name), None)
        if twin:
            text = f"found the package '{package.name}' twice, also in {twin.folder}"
            problems.append(problem_at(folder / MANIFEST, text))
        else:
            packages.append(package)
    return packages, problems


def misplaced(folder: Path) -> list[Path]:
    """Interface files of a package that are of no use where they are, or as they are (IDL)."""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if f[0] != "." and f not in _NOT_SOURCES)
        for name in sorted(names):
            file = Path(place, name).relative_to(folder)
            if file.suffix[1:] in (*KINDS, "idl") and file.parent.as_posix() != file.suffix[1:]:
                found.append(file)
    return found


def wrong_place(file: Path) -> str:
    """The problem of an interface file that is IDL, or in another folder than it should be."""
    if file.suffix == ".idl":
        return (
            f"{file.name} is IDL, which NeuROS does not build: write the type as"
            f" {file.parent.name or 'msg'}/{file.stem}.msg (.srv, .action)"
        )
    kind, place = (
        file.suffix[1:],
        "" if file.parent == Path() else f" in the folder '{file.parent}'",
    )
    return f"found {file.name}{place}, expected it in the folder '{kind}' beside {MANIFEST}"


def problem_at(file: Path, text: str, line: int = 1, column: int = 1, hint: str = "") -> Problem:
    """A problem at a place in a file; its path is relative to the current folder, if below it."""
    try:
        shown = file.relative_to(Path.cwd())
    except ValueError:
        shown = file
    return Problem(str(shown), line, column, "", text, hint)


class ManifestError(Exception):
    """A ``package.xml`` that cannot be used."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        super().__init__(str(problem))


def _read(folder: Path, files: tuple[Path, ...], others: Sequence[Path]) -> Package | None:
    """Read the manifest; ``None`` for a package without interfaces for ROS to build.

    Args:
        others: its interface files in other folders, if it has none in the right ones.
    """
    # Imported here: it takes 50 ms, and most projects have no message packages.
    from catkin_pkg.package import InvalidPackage, parse_package_string

    file = folder / MANIFEST
    try:
        manifest = parse_package_string(file.read_text("utf-8"), str(file), warnings=[])
    except RecursionError as error:
        text = "its elements are nested too deeply"
        raise ManifestError(problem_at(file, text, 1)) from error
    except (InvalidPackage, OSError, UnicodeError, AssertionError, ValueError) as error:
        lines = str(error).splitlines() or [""]
        text = " ".join(
            line.strip() for line in lines if not line.startswith("Error(s) in package")
        )
        line = getattr(error.__context__, "lineno", 1)  # a missing element has no line
        raise ManifestError(problem_at(file, text, int(line))) from error
    if len(manifest.name) > _LONGEST_NAME:
        text = f"the name of the package has {len(manifest.name)} characters, at most"
        raise ManifestError(problem_at(file, f"{text} {_LONGEST_NAME} are allowed"))
    if others:
        tools = (*manifest.buildtool_depends, *manifest.build_depends, *manifest.member_of_groups)
        if all(each.name not in _BUILDS_INTERFACES for each in tools):
            return None
        more = f" (and {len(others) - 1} more)" if len(others) > 1 else ""
        raise ManifestError(problem_at(folder / others[0], f"{wrong_place(others[0])}{more}"))
    depends = (*manifest.build_depends, *manifest.build_export_depends, *manifest.exec_depends)
    declared = frozenset(each.name for each in depends)
    return Package(manifest.name, folder, files, declared, _used(folder, files) - {manifest.name})


def _used(folder: Path, files: Sequence[Path]) -> frozenset[str]:
    """The packages that interface files name, as in ``std_msgs/Header header``."""
    used: set[str] = set()
    for file in files:
        with contextlib.suppress(OSError):  # the check of message packages reports it
            used |= {name.decode() for name in _USED.findall((folder / file).read_bytes())}
    return frozenset(used)


@dataclass(frozen=True)
class Ros:
    """An installation of ROS: where its headers, libraries and descriptions are.

    Attributes:
        prefix: holds ``include``, ``lib`` and ``share``; for wheels, the prefix of their Python.
    """

    prefix: Path

    @classmethod
    def here(cls) -> Ros:
        """The ROS of this Python."""
        return cls(Path(sys.prefix))

    @property
    def include(self) -> Path:
        return self.prefix / "include"

    @property
    def lib(self) -> Path:
        return self.prefix / "lib"

    def share(self, package: str) -> Path:
        """The folder of the descriptions of a package, which may be missing."""
        return self.prefix / "share" / package

    def has(self, package: str) -> bool:
        # Path.is_file() raises for a name that is too long.
        return os.path.isfile(self.share(package) / MANIFEST)

    def messages(self, package: str) -> Collection[str] | None:
        """The names of the messages of a package, ``None`` if there is no such package."""
        if not self.has(package):
            return None
        return {file.stem for file in self.share(package).glob("msg/*.idl")}

    def message_packages(self) -> set[str]:
        return {folder.parent.name for folder in (self.prefix / "share").glob("*/msg")}

    def manifest(self, package: str) -> bytes:
        """The manifest of a package, which has its version; empty if it is not installed."""
        return (self.share(package) / MANIFEST).read_bytes() if self.has(package) else b""
