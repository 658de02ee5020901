"""Compiles generated C to libraries with gcc, called as CMake calls it for a release."""

from __future__ import annotations

import os
import shutil
import subprocess
import sysconfig
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.installation.machine import system_install
from neuros.messages.generation import generated
from neuros.messages.package import Ros

_ABI = Path(__file__).with_name("stable_abi.h")
_C = ("-std=gnu11", "-O2", "-fPIC", "-DNDEBUG", "-w")
_CPP = ("-std=c++17", "-O2", "-fPIC", "-DNDEBUG", "-w")
_LINK = ("-shared", "-Wl,--strip-all", "-Wl,--as-needed", "-Wl,--no-undefined")
HEADERS = (
    "rosidl_generator_c",
    "rosidl_typesupport_introspection_c",
    "rosidl_typesupport_fastrtps_c",
)
"""The generators that write headers."""

_TO_C, _TO_PYTHON = "rosidl_generator_c", "rosidl_generator_py"
# Each library with what it needs of ROS; generators of its name make its code.
_LIBRARIES: Mapping[str, Sequence[str]] = {
    "rosidl_generator_c": ("rosidl_runtime_c", "rosidl_typesupport_c", "rcutils"),
    "rosidl_typesupport_introspection_c": (
        "rosidl_runtime_c",
        "rosidl_typesupport_introspection_c",
    ),
    "rosidl_typesupport_fastrtps_c": (
        *("rosidl_runtime_c", "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_fastrtps_cpp"),
        *("fastcdr", "rmw"),
    ),
    "rosidl_typesupport_c": ("rosidl_runtime_c", "rosidl_typesupport_c"),
    "rosidl_generator_py": ("rosidl_runtime_c",),
}


class CompilationError(Exception):
    """An error of the compiler, with its output."""


@dataclass(frozen=True)
class Compilers:
    """The programs, and the headers of Python and NumPy."""

    c: str
    cpp: str
    python_headers: Sequence[Path]

    @classmethod
    def here(cls) -> Compilers:
        """Those of this machine.

        Raises:
            EnvironmentFault: with the command that installs what is missing.
        """
        c, cpp = shutil.which("gcc"), shutil.which("g++")
        remedy = system_install(apt="gcc g++ python3-dev", dnf="gcc gcc-c++ python3-devel")
        if c is None or cpp is None:
            raise EnvironmentFault(
                f"message packages need a C and C++ compiler, and there is no"
                f" {'g++' if c else 'gcc'}: {remedy}, then again"
            )
        include = Path(sysconfig.get_path("include"))
        if not (include / "Python.h").is_file():
            raise EnvironmentFault(
                f"message packages need the headers of Python, and {include} has no Python.h:"
                f" {remedy}, then again"
            )
        import numpy

        return cls(c, cpp, (include, Path(numpy.get_include())))


@dataclass(frozen=True)
class Job:
    """A package to compile.

    Attributes:
        source: the output of the generators.
        prefix: gets ``lib``, ``include`` and ``python``.
        others: the packages whose messages this one contains, or refers to.
        built: the packages of workspaces that it needs, by name: the folders of their builds.
    """

    package: str
    source: Path
    prefix: Path
    others: Collection[str]
    built: Mapping[str, Path]
    ros: Ros
    compilers: Compilers
    environment: Mapping[str, str]

    def library(self, kind: str) -> Path:
        return self.prefix / "lib" / f"lib{self.package}__{kind}.so"


def compile_package(job: Job) -> None:
    """Make the libraries of a package and its module for Python.

    Raises:
        CompilationError: if the compiler fails.
    """
    sources = [
        file
        for kind in _LIBRARIES
        for file in sorted(generated(job.source, kind, job.package).rglob("*.c*"))
    ]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        objects = dict(
            zip(sources, pool.map(lambda file: _compile(job, file), sources), strict=True)
        )
    (job.prefix / "lib").mkdir(parents=True)
    entry = f"_{job.package}_s.ep."
    for kind, needs in _LIBRARIES.items():
        folder = generated(job.source, kind, job.package)
        own = [o for s, o in objects.items() if folder in s.parents and entry not in s.name]
        _link_library(job, kind, own, needs)
    _link_module(job, [o for s, o in objects.items() if s.name.startswith(entry)])


def _compile(job: Job, source: Path) -> Path:
    out = source.with_suffix(f"{source.suffix}.o")
    own = [generated(job.source, kind, job.package).parent for kind in HEADERS]
    others = [folder / "include" / name for name, folder in job.built.items()]
    # In ROS the headers of a package are in a folder of its name twice; fastcdr has one.
    ros = [job.ros.include, *sorted(p for p in job.ros.include.iterdir() if p.is_dir())]
    python: list[str] = []
    if generated(job.source, _TO_PYTHON, job.package) in source.parents:
        python = ["-include", str(_ABI)]
        ros = [*job.compilers.python_headers, *ros]
    is_c = source.suffix == ".c"
    command = [job.compilers.c, *_C] if is_c else [job.compilers.cpp, *_CPP]
    includes = [*(f"-I{folder}" for folder in own), *(f"-isystem{p}" for p in (*others, *ros))]
    _run(job, [*command, *includes, *python, "-c", str(source), "-o", str(out)])
    return out


def _link_library(job: Job, kind: str, objects: Sequence[Path], needs: Iterable[str]) -> None:
    out = job.library(kind)
    kinds = dict.fromkeys([kind, _TO_C])
    own = [job.library(_TO_C)] if kind != _TO_C else []
    others = [_library_of(job, other, which) for other in sorted(job.others) for which in kinds]
    libraries = [*own, *others, *(job.ros.lib / f"lib{name}.so" for name in needs)]
    # Python brings its symbols itself, and its libraries differ from one version to the next.
    undefined = ["-Wl,--unresolved-symbols=ignore-all"] if kind == _TO_PYTHON else []
    command = [
        *(job.compilers.cpp, *_LINK, *undefined, "-o", str(out), f"-Wl,-soname,{out.name}"),
        *map(str, objects),
        *(str(library) for library in libraries if library.exists()),
        *_search(job, "$ORIGIN"),
    ]
    _run(job, command)


def _link_module(job: Job, objects: Sequence[Path]) -> None:
    """Link the module that Python imports; it brings all libraries along.

    ROS opens some of them by their names, and finds those that are open already.
    """
    out = job.prefix / "python" / job.package / f"{job.package}_s__rosidl_typesupport_c.abi3.so"
    out.parent.mkdir(parents=True)
    command = [
        *(job.compilers.c, *_LINK, "-Wl,--no-as-needed", "-Wl,--unresolved-symbols=ignore-all"),
        *("-o", str(out)),
        *map(str, objects),
        *(str(job.library(kind)) for kind in _LIBRARIES),
        *_search(job, "$ORIGIN/../../lib"),
    ]
    _run(job, command)


def _library_of(job: Job, other: str, kind: str) -> Path:
    """A library of another package, which need not be there."""
    name = f"lib{other}__{kind}.so"
    return (job.built[other] / "lib" if other in job.built else job.ros.lib) / name


def _search(job: Job, lib: str) -> list[str]:
    """Where libraries look for others: beside them, and in the packages of the workspaces."""
    up = f"{lib}/../.."
    folders = [lib, *(f"{up}/{folder.name}/lib" for folder in job.built.values())]
    linked = [f"-Wl,-rpath-link,{folder}" for folder in (job.prefix / "lib", job.ros.lib)]
    linked += [f"-Wl,-rpath-link,{folder / 'lib'}" for folder in job.built.values()]
    return [f"-Wl,-rpath,{':'.join(folders)}", *linked]


def _run(job: Job, command: Sequence[str]) -> None:
    run_program(command, job.environment, folder=job.source)


def run_program(
    command: Sequence[str],
    environment: Mapping[str, str],
    given: str = "",
    folder: Path | None = None,
) -> None:
    """Run a program of the build; raises ``CompilationError`` if it fails.

    Args:
        given: for its standard input.
    """
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        input=given,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    if done.returncode:
        raise CompilationError(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
