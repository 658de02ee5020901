"""All message packages that a project sees: their order, keys and mistakes in manifests.

Built packages are cached::

    ~/.cache/neuros/messages/         (or $XDG_CACHE_HOME/neuros/messages)
        <package>-<key>/              a built package, whole from its first moment
            python/<package>/         what Python imports
            lib/                      its C libraries
            share/<package>/          definitions, and type descriptions with their hashes
            include/<package>/        headers, for packages that depend on it
        <package>-<key>.lock          only while it is being built
        <package>-<key>.log           what the generators and the compiler wrote, after a failure

A package is built in a folder beside, which gets its name when it is whole. The libraries of one
find those of another by the path between their folders: the cache can be anywhere.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shutil
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from neuros.caching import KEY_LENGTH, UNUSED_S, Kept, cache_root, kept_in
from neuros.errors import Problem
from neuros.messages.package import MANIFEST, Package, Ros, find_packages, problem_at
from neuros.project.message_types import MessageField

_FORMAT = b"1"  # of what is built; another one builds everything anew
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
    """The packages with messages in some workspaces; of two with one name the first counts.

    Nothing is read before something is asked, and the shared one last: most projects need none.

    Args:
        own: the workspace of the project: all its packages are built.
        shared: the workspace of NeuROS: those that are needed are built.
        environ: says where built packages are kept.
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
        """All of them, by name."""
        return {**self._shared.packages, **self._own.packages}

    @property
    def own(self) -> set[str]:
        """The names of those in the project's workspace."""
        return set(self._own.packages)

    @property
    def own_problems(self) -> list[Problem]:
        """Mistakes in manifests of the project's workspace."""
        return self._own.problems

    @property
    def problems(self) -> list[Problem]:
        """Mistakes in manifests."""
        return [*self._own.problems, *self._shared.problems]

    def messages(self, package: str) -> Collection[str] | None:
        """The names of the messages of a package, ``None`` if it is not in a workspace."""
        return self.packages[package].messages if package in self.packages else None

    def installed(self, package: str) -> Path | None:
        """The folder that a package is built into, ``None`` if it is not in a workspace."""
        try:
            return next((b.folder for b in self.builds([package]) if b.package == package), None)
        except CycleError:
            return None

    def fields(self, package: str, name: str) -> dict[str, MessageField] | None:
        """The fields of a message, ``None`` if it is in no workspace, or its file is wrong."""
        if name not in (self.messages(package) or ()):
            return None
        from rosidl_adapter.parser import InvalidSpecification, parse_message_file

        try:
            file = self.packages[package].folder / "msg" / f"{name}.msg"
            message = parse_message_file(package, file)
        except (OSError, ValueError, TypeError, AssertionError, InvalidSpecification):
            return None  # the check of message packages says so
        return {
            each.name: MessageField(_type_name(each.type), is_array=each.type.is_array)
            for each in message.fields
        }

    def builds(self, names: Iterable[str]) -> list[Built]:
        """Packages and all that they depend on, built or not, as :meth:`closure` orders them."""
        packages = self.closure(names)
        keys = self._keys(packages)
        return [Built(self._cache / f"{p.name}-{keys[p.name]}") for p in packages]

    def closure(self, names: Iterable[str]) -> list[Package]:
        """Packages and all that they depend on, each after those that it needs.

        Raises:
            CycleError: if there is no such order.
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
        """The packages of the workspaces that one of them names."""
        return sorted(self.packages[name].dependencies & set(self.packages) - {name})

    def _keys(self, packages: Sequence[Package]) -> dict[str, str]:
        """The key of each package.

        It changes with the content of the package, of those that it needs, and with the version
        of the generators and of ROS's own packages; not with that of Python.
        """
        tools = b"".join(self.ros.manifest(name) for name in GENERATORS)
        keys: dict[str, str] = {}
        for package in packages:
            digest = hashlib.sha256(_FORMAT + _ABI.read_bytes() + tools)
            digest.update(platform.machine().encode())
            for file in (Path(MANIFEST), *package.files):
                digest.update(f"{file.as_posix()}\0".encode() + _content(package.folder / file))
            for name in sorted(package.dependencies):
                there = keys[name].encode() if name in keys else self.ros.manifest(name)
                digest.update(f"{name}\0{len(there)}\0".encode() + there)
            keys[package.name] = digest.hexdigest()[:KEY_LENGTH]
        return keys


def _content(file: Path) -> bytes:
    try:
        content = file.read_bytes()
    except OSError:
        return b"unreadable"  # checking says so
    return f"{len(content)}\0".encode() + content


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
    """The problem of packages that need each other."""
    names: list[str] = error.args[1]
    package = workspaces.packages[names[0]]
    text = f"found packages that need each other: {' -> '.join(names)}"
    return problem_at(package.folder / MANIFEST, text)


def _type_name(declared: Any) -> str:
    """Of a type of rosidl's parser: ``float64``, ``geometry_msgs/msg/Vector3``."""
    own = str(declared.type)
    return own if declared.pkg_name is None else f"{declared.pkg_name}/msg/{own}"


def message_cache(environ: Mapping[str, str]) -> Path:
    """The folder of built packages."""
    return cache_root(environ) / "messages"


@dataclass(frozen=True)
class Built(Kept):
    """One package, built or not; the log has what the generators and the compiler wrote."""

    @property
    def package(self) -> str:
        """The name of the package."""
        return self.folder.name[: -KEY_LENGTH - 1]

    @property
    def python(self) -> Path:
        """The folder for Python's path."""
        return self.folder / "python"

    @property
    def share(self) -> Path:
        return self.folder / "share" / self.package

    @property
    def draft(self) -> Path:
        """The folder in which it is built."""
        return self.beside(".draft")

    @property
    def is_there(self) -> bool:
        return self.folder.is_dir()

    def note_use(self) -> None:
        """Keep it from being removed as unused."""
        with contextlib.suppress(OSError):
            os.utime(self.folder)


def sweep(cache: Path) -> None:
    """Remove what was interrupted, and what no run has used for a month."""
    oldest_s = time.time() - UNUSED_S
    for built in map(Built, kept_in(cache)):
        with contextlib.suppress(OSError), built.locked(wait=False) as is_mine:
            if is_mine:
                shutil.rmtree(built.draft, ignore_errors=True)
                _remove_if_older(built, oldest_s)


def _remove_if_older(built: Built, oldest_s: float) -> None:
    if built.is_there and built.folder.stat().st_mtime < oldest_s:
        built.folder.rename(built.draft)  # gone at once: half of it must not count as built
        shutil.rmtree(built.draft, ignore_errors=True)
    if built.log.exists() and built.log.stat().st_mtime < oldest_s:
        built.log.unlink()
