"""The message packages of a run: which it needs, and their building, each whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from graphlib import CycleError
from importlib.util import find_spec
from pathlib import Path

from neuros.errors import EnvironmentFault, Problem
from neuros.installation.machine import system_install
from neuros.installation.progress import Progress
from neuros.messages import generation
from neuros.messages.generation import generated
from neuros.messages.package import MANIFEST, Package, Ros
from neuros.messages.workspace import Built, Workspaces, cycle_problem, sweep
from neuros.project.model import Node

# What services and actions are made of, besides what their files name.
_IMPLIED: Mapping[str, set[str]] = {
    ".msg": set(),
    ".srv": {"service_msgs", "builtin_interfaces"},
    ".action": {
        *("action_msgs", "builtin_interfaces", "service_msgs", "unique_identifier_msgs"),
    },
}


@dataclass(frozen=True)
class Step:
    """A package that is to be built.

    Attributes:
        needs: the packages of workspaces that it needs, directly or not, all built before it.
    """

    package: Package
    built: Built
    needs: Sequence[Built]


class Messages:
    """Packages of workspaces, with all that they need, in the order of their building.

    Args:
        names: of packages; those that are in no workspace are left out.
    """

    def __init__(self, workspaces: Workspaces, names: Iterable[str]) -> None:
        self._workspaces = workspaces
        self._steps: list[Step] = []
        wanted = sorted(names)
        self._problems = list(workspaces.problems if wanted else workspaces.own_problems)
        if not wanted:
            return
        try:
            builds = workspaces.builds(wanted)
        except CycleError as error:
            self._problems.append(cycle_problem(workspaces, error))
            return
        by_name = {built.package: built for built in builds}
        for built in builds:
            needs = workspaces.closure(workspaces.needs(built.package))
            package = workspaces.packages[built.package]
            self._steps.append(Step(package, built, [by_name[need.name] for need in needs]))

    @classmethod
    def of_nodes(cls, nodes: Iterable[Node], workspaces: Workspaces) -> Messages:
        """The packages that nodes need: all of the project, and the shared ones that ports name."""
        ports = (port for node in nodes for port in (*node.inputs, *node.outputs))
        used = {port.type.partition("/")[0] for port in ports}
        # Shared ones are not looked for where everything comes with ROS, as it mostly does.
        names = used if any(find_spec(package) is None for package in used) else ()
        return cls(workspaces, {*workspaces.own, *names})

    @property
    def built(self) -> list[Built]:
        """Each package, built or not."""
        return [step.built for step in self._steps]

    @property
    def paths(self) -> tuple[Path, ...]:
        """The folders for Python's path."""
        return tuple(built.python for built in self.built)

    @property
    def is_made(self) -> bool:
        """Whether everything is built."""
        return all(built.is_there for built in self.built)

    def problems(self) -> list[Problem]:
        """Mistakes in the files of packages; a built package had none."""
        missing = [step.package for step in self._steps if not step.built.is_there]
        if not missing:
            return self._problems
        # Imported here: most of the time everything is built.
        from neuros.messages.checking import check

        return [*self._problems, *check(missing, self._workspaces)]

    def note_use(self) -> None:
        """Keep it all from being removed as unused."""
        for built in self.built:
            built.note_use()

    def make(self, progress: Progress, environment: Mapping[str, str]) -> None:
        """Build what is missing.

        Args:
            environment: of the programs that this starts.

        Raises:
            EnvironmentFault: with a sentence for the user.
        """
        missing = [step for step in self._steps if not step.built.is_there]
        if not missing:
            return
        builder = _Builder(self._workspaces, Compilers.here(), progress, environment)
        for step in missing:
            builder.build(step)
        sweep(missing[0].built.folder.parent)

    def describe(self) -> list[str]:
        """One line per package."""
        return [
            f"message package {step.package.name}"
            f"{'' if step.built.is_there else ', which launching builds first'}:"
            f" {step.built.folder}"
            for step in self._steps
        ]


@dataclass(frozen=True)
class _Builder:
    """Builds packages, with a line of progress for each."""

    workspaces: Workspaces
    compilers: Compilers
    progress: Progress
    environment: Mapping[str, str]

    def build(self, step: Step) -> None:
        """Build a package, or wait until another program has built it.

        Raises:
            EnvironmentFault: with a sentence for the user; then nothing of the package is left but
                a log.
        """
        name, built = step.package.name, step.built
        try:
            with built.locked(wait=False) as is_mine:
                if is_mine:
                    self._build(step)
                    return
            self.progress.step(f"waiting for another program that builds {name}")
            with built.locked():
                self._build(step)
        except OSError as error:
            raise EnvironmentFault(
                f"message package '{name}' cannot be built in {built.folder.parent}"
                f" ({error.strerror or error}): make room (df -h), or set XDG_CACHE_HOME"
            ) from error

    def _build(self, step: Step) -> None:
        """Build one package; its lock is held."""
        package, built = step.package, step.built
        if built.is_there:  # by another program, meanwhile
            return
        self.progress.step(f"building {package.name}: {package.summary} ({package.folder})")
        draft, source = built.draft, built.draft / "source"
        shutil.rmtree(draft, ignore_errors=True)
        try:
            source.mkdir(parents=True)
            self._generate(step, source)
            others = _others(package, source)
            needs = {need.package: need.folder for need in step.needs}
            tools = (self.workspaces.ros, self.compilers, self.environment)
            compile_package(Job(package.name, source, draft, others, needs, *tools))
            _install(package, source, draft)
            shutil.rmtree(source)
            if built not in self.workspaces.builds([package.name]):
                raise EnvironmentFault(
                    f"message package '{package.name}' was changed while it was built: start again"
                )
            draft.rename(built.folder)
            built.log.unlink(missing_ok=True)
        except CompilationError as error:
            built.log.write_text(str(error), "utf-8")
            raise EnvironmentFault(
                f"message package '{package.name}' cannot be built: {_cause(str(error))} (log:"
                f" {built.log})"
            ) from error
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def _generate(self, step: Step, source: Path) -> None:
        package, ros = step.package, self.workspaces.ros
        shares = {name: str(ros.share(name)) for name in ros.message_packages()}
        shares |= {need.package: str(need.share) for need in step.needs}
        order = generation.Order(
            package.name,
            str(package.folder),
            [file.as_posix() for file in package.files],
            str(source),
            str(ros.prefix),
            shares,
        )
        # By its path and isolated: it needs nothing of NeuROS, and nothing that PYTHONPATH names.
        command = [sys.executable, "-I", generation.__file__]
        _run_program(command, self.environment, order.text())


def _others(package: Package, source: Path) -> set[str]:
    """The packages that its messages refer to, with what these refer to."""
    others = {name for file in package.files for name in _IMPLIED[file.suffix]}
    descriptions = generation.generated(source, generation.DESCRIPTIONS, package.name)
    for file in descriptions.rglob("*.json"):
        hashes = json.loads(file.read_text("utf-8"))["type_hashes"]
        others |= {each["type_name"].partition("/")[0] for each in hashes}
    return others - {package.name}


def _install(package: Package, source: Path, prefix: Path) -> None:
    """Put what was generated where it is looked for, as in a ROS distribution."""
    share, python = prefix / "share" / package.name, prefix / "python" / package.name
    for generator in (generation.INTERFACES, generation.DESCRIPTIONS):
        _copy(generation.generated(source, generator, package.name), share, {".idl", ".json"})
    for file in (Path(MANIFEST), *package.files):
        shutil.copyfile(package.folder / file, share / file)
    for generator in HEADERS:
        folder = generation.generated(source, generator, package.name)
        _copy(folder, prefix / "include" / package.name / package.name, {".h"})
    _copy(generation.generated(source, "rosidl_generator_py", package.name), python, {".py"})
    (python / "__init__.py").touch()
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / package.name).touch()


def _copy(source: Path, target: Path, suffixes: set[str]) -> None:
    for file in source.rglob("*"):
        if file.suffix in suffixes:
            out = target / file.relative_to(source)
            out.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, out)


def _cause(output: str) -> str:
    """The line that says most: the first error of the compiler, or the last one of a generator."""
    rows = [row.strip() for row in output.splitlines() if row.strip()]
    errors = [row for row in rows if re.search(r"\berror: ", row)]
    return (errors[:1] or rows[-1:] or ["for no known reason"])[0][:300]


# ---------------------------------------------------------------------- compilation
#
# Compiles generated C to libraries with gcc, called as CMake calls it for a release.


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
    _run_program(command, job.environment, folder=job.source)


def _run_program(
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
