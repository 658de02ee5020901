"""All message packages that a project sees: their order, keys and mistakes in manifests.

Built packages are cached::

    ~/.cache/neuros/messages/         (or $XDG_CACHE_HOME/neuros/messages)
        <package>-<key>/              a built package, always complete
            python/<package>/         what Python imports
            lib/                      its C libraries
            share/<package>/          definitions, and type descriptions with their hashes
            include/<package>/        headers, for packages that depend on it
        <package>-<key>.lock          only while it is being built
        <package>-<key>.log           output of the generators and the compiler, after a failure

A package is built in another folder, which is renamed when it is complete. Libraries find those of
other packages by the relative path between their folders: the cache can be anywhere.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from neuros.caching import KEY_LENGTH, Kept, cache_root
from neuros.errors import Problem
from neuros.messages.package import (
    MANIFEST,
    Package,
    Ros,
    find_packages,
    misplaced,
    problem_at,
    wrong_place,
)
from neuros.project.message_types import MessageField

_FORMAT = b"1"  # of built packages; a change builds all packages again
_ABI = Path(__file__).with_name("stable_abi.h")
GENERATORS = (
    "rosidl_adapter",
    "rosidl_generator_type_description",
    "rosidl_generator_c",
    "rosidl_typesupport_introspection_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_c",
    "rosidl_generator_py",
)
"""Programs that turn definitions into code, in this order."""


class Workspaces:
    """The packages with messages in two workspaces; a package of the project hides a shared one.

    Workspaces are read when they are needed, since most projects need none.

    Args:
        own: the workspace of the project, of which all packages are built.
        shared: the workspace of NeuROS, of which the needed packages are built.
        environ: tells the folder of the cache.
    """

    def __init__(
        self,
        own: Path | None,
        shared: Path | None,
        environ: Mapping[str, str],
        ros: Ros | None = None,
    ) -> None:
        self._folders = (own, shared)
        self._cache = message_cache(environ)
        self.ros = ros or Ros.here()

    @cached_property
    def _own(self) -> _Found:
        return _find(self._folders[0])

    @cached_property
    def _shared(self) -> _Found:
        own, shared = self._folders
        return _find(None if own and shared and own.resolve() == shared.resolve() else shared)

    @cached_property
    def packages(self) -> dict[str, Package]:
        return {**self._shared.packages, **self._own.packages}

    @property
    def own(self) -> set[str]:
        """The names of packages in the workspace of the project."""
        return set(self._own.packages)

    @property
    def own_problems(self) -> list[Problem]:
        """Mistakes in manifests of the workspace of the project."""
        return self._own.problems

    @property
    def problems(self) -> list[Problem]:
        """Mistakes in manifests of both workspaces."""
        return [*self._own.problems, *self._shared.problems]

    def messages(self, package: str) -> Collection[str] | None:
        """The names of the messages of a package, ``None`` if it is not in a workspace."""
        return self.packages[package].messages if package in self.packages else None

    def elsewhere(self, package: str, name: str) -> str:
        """Where a package of a workspace has a message of this name, if wrongly."""
        if package not in self.packages:
            return ""
        names = (f"{name}.msg", f"{name}.idl")
        others = (f for f in misplaced(self.packages[package].folder) if f.name in names)
        return next(map(wrong_place, others), "")

    def installed(self, package: str) -> Path | None:
        """The folder of the build of a package, ``None`` if it is not in a workspace."""
        try:
            builds = self.builds([package])
            return builds[-1].built.folder if builds else None
        except CycleError:
            return None

    def fields(self, package: str, name: str) -> dict[str, MessageField] | None:
        """The fields of a message, ``None`` if it is in no workspace, or its file has mistakes."""
        if name not in (self.messages(package) or ()):
            return None
        from rosidl_adapter.parser import InvalidSpecification, parse_message_file

        try:
            file = self.packages[package].folder / "msg" / f"{name}.msg"
            message = parse_message_file(package, file)
        except (OSError, ValueError, TypeError, AssertionError, InvalidSpecification):
            return None  # the check of message packages reports it
        found = {}
        for each in message.fields:  # of type float64, or geometry_msgs/msg/Vector3
            declared = each.type
            package_name = "" if declared.pkg_name is None else f"{declared.pkg_name}/msg/"
            found[each.name] = MessageField(
                f"{package_name}{declared.type}", is_array=declared.is_array
            )
        return found

    def builds(self, names: Iterable[str]) -> list[PackageBuild]:
        """Packages and all that they depend on, built or not, as :meth:`closure` orders them.

        The key of a package changes with its content, with that of the packages that it needs, and
        with the versions of the generators and of packages of ROS; not with that of Python.
        """
        builds: dict[str, PackageBuild] = {}
        tools = b"".join(self.ros.manifest(name) for name in GENERATORS)
        keys: dict[str, str] = {}
        for package in self.closure(names):
            digest = hashlib.sha256(_FORMAT + _ABI.read_bytes() + tools)
            digest.update(platform.machine().encode())
            for file in (Path(MANIFEST), *package.files):
                try:
                    content = (package.folder / file).read_bytes()
                    content = f"{len(content)}\0".encode() + content
                except OSError:
                    content = b"unreadable"  # the check of message packages reports it
                digest.update(f"{file.as_posix()}\0".encode() + content)
            for name in sorted(package.dependencies):
                there = keys[name].encode() if name in keys else self.ros.manifest(name)
                digest.update(f"{name}\0{len(there)}\0".encode() + there)
            key = keys[package.name] = digest.hexdigest()[:KEY_LENGTH]
            built = Built(self._cache / f"{package.name}-{key}")
            needs = (builds[name] for name in self.needs(package.name))
            all_needs = dict.fromkeys(each for need in needs for each in (*need.needs, need.built))
            builds[package.name] = PackageBuild(package, built, tuple(all_needs))
        return list(builds.values())

    def closure(self, names: Iterable[str]) -> list[Package]:
        """Packages and all that they depend on, each after the packages that it needs.

        Raises:
            CycleError: if packages need each other.
        """
        graph: dict[str, set[str]] = {}
        pending = [name for name in names if name in self.packages]
        while pending:
            name = pending.pop()
            if name not in graph:
                graph[name] = set(self.needs(name))
                pending += graph[name]
        sorter = TopologicalSorter({name: sorted(graph[name]) for name in sorted(graph)})
        return [self.packages[name] for name in sorter.static_order()]

    def needs(self, name: str) -> list[str]:
        """The packages of the workspaces that a package depends on."""
        return sorted(self.packages[name].dependencies & set(self.packages) - {name})


@dataclass(frozen=True)
class _Found:
    packages: dict[str, Package] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)


def _find(folder: Path | None) -> _Found:
    if folder is None or not folder.is_dir():
        return _Found()
    packages, problems = find_packages(folder.resolve())
    return _Found({package.name: package for package in packages}, problems)


def cycle_problem(workspaces: Workspaces, error: CycleError) -> Problem:
    names: list[str] = error.args[1]
    package = workspaces.packages[names[0]]
    text = f"found packages that need each other: {' -> '.join(names)}"
    return problem_at(package.folder / MANIFEST, text)


def message_cache(environ: Mapping[str, str]) -> Path:
    """The folder of built packages."""
    return cache_root(environ) / "messages"


@dataclass(frozen=True)
class Built(Kept):
    """The build of one package, which may be missing."""

    @property
    def package(self) -> str:
        return self.folder.name[: -KEY_LENGTH - 1]

    @property
    def python(self) -> Path:
        return self.folder / "python"

    @property
    def share(self) -> Path:
        return self.folder / "share" / self.package

    @property
    def is_there(self) -> bool:
        return self.folder.is_dir()

    def record_use(self) -> None:
        """Keep the build from being removed as unused."""
        with contextlib.suppress(OSError):
            os.utime(self.folder)


@dataclass(frozen=True)
class PackageBuild:
    """A package, and the folder that it is built into.

    Attributes:
        needs: builds of workspace packages that this one needs, directly or not; all come first.
    """

    package: Package
    built: Built
    needs: tuple[Built, ...]
