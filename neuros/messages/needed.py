"""The message packages of a run: which it needs, and their building, each whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from graphlib import CycleError
from importlib.util import find_spec
from pathlib import Path

from neuros.caching import sweep
from neuros.errors import EnvironmentFault, Problem
from neuros.installation.machine import system_install
from neuros.installation.progress import Progress
from neuros.messages import generation
from neuros.messages.package import MANIFEST, Package
from neuros.messages.workspace import Built, PackageBuild, Workspaces, cycle_problem
from neuros.project.model import Node

# Packages that the generated code of services and actions needs, beside those in their files.
_IMPLIED: Mapping[str, set[str]] = {
    ".msg": set(),
    ".srv": {"service_msgs", "builtin_interfaces"},
    ".action": {
        *("action_msgs", "builtin_interfaces", "service_msgs", "unique_identifier_msgs"),
    },
}


class Messages:
    """Packages of workspaces with all that they need, in the order in which they are built.

    Args:
        names: packages; those of no workspace are left out.
    """

    def __init__(self, workspaces: Workspaces, names: Iterable[str]) -> None:
        self._workspaces = workspaces
        self._builds: list[PackageBuild] = []
        wanted = sorted(names)
        self._problems = list(workspaces.problems if wanted else workspaces.own_problems)
        try:
            self._builds = workspaces.builds(wanted) if wanted else []
        except CycleError as error:
            self._problems.append(cycle_problem(workspaces, error))

    @classmethod
    def of_nodes(cls, nodes: Iterable[Node], workspaces: Workspaces) -> Messages:
        """The packages that nodes need: all of the project, and shared ones that ports name."""
        ports = (port for node in nodes for port in (*node.inputs, *node.outputs))
        used = {port.ros_type.partition("/")[0] for port in ports}
        # The shared workspace is not searched if all packages come with ROS, as they mostly do.
        names = used if any(find_spec(package) is None for package in used) else ()
        return cls(workspaces, {*workspaces.own, *names})

    @property
    def built(self) -> list[Built]:
        return [build.built for build in self._builds]

    @property
    def paths(self) -> tuple[Path, ...]:
        """The folders for Python's path."""
        return tuple(built.python for built in self.built)

    @property
    def is_made(self) -> bool:
        return all(built.is_there for built in self.built)

    @property
    def _missing(self) -> list[Package]:
        return [build.package for build in self._builds if not build.built.is_there]

    def problems(self) -> list[Problem]:
        """Mistakes in the files of packages; a built package had none."""
        missing = self._missing
        if not missing:
            return self._problems
        # Imported here: most of the time everything is built.
        from neuros.messages.checking import check

        return [*self._problems, *check(missing, self._workspaces)]

    def doubts(self) -> list[Problem]:
        """What ROS may refuse in packages that are not built yet."""
        if not (missing := self._missing):
            return []
        from neuros.messages.checking import undeclared

        return undeclared(missing)

    def record_use(self) -> None:
        """Keep the builds from being removed as unused."""
        for built in self.built:
            built.record_use()

    def make(self, progress: Progress, environment: Mapping[str, str]) -> None:
        """Build what is missing.

        Args:
            environment: of the generators and compilers.

        Raises:
            EnvironmentFault: if a package cannot be built.
        """
        missing = [build for build in self._builds if not build.built.is_there]
        if not missing:
            return
        compilers = Compilers.here()
        for build in missing:
            _Builder(build, self._workspaces, compilers, progress, environment).run()
        sweep(missing[0].built.folder.parent)

    def describe(self) -> list[str]:
        """One line per package."""
        return [
            f"message package {build.package.name}"
            f"{'' if build.built.is_there else ', which launching builds first'}:"
            f" {build.built.folder}"
            for build in self._builds
        ]


_ABI = Path(__file__).with_name("stable_abi.h")
_C = ("-std=gnu11", "-O2", "-fPIC", "-DNDEBUG", "-w")
_CPP = ("-std=c++17", "-O2", "-fPIC", "-DNDEBUG", "-w")
_LINK = ("-shared", "-Wl,--strip-all", "-Wl,--as-needed", "-Wl,--no-undefined")
# Python brings its symbols itself, and its libraries differ from one version to the next.
_UNRESOLVED = "-Wl,--unresolved-symbols=ignore-all"
_TO_C, _TO_PYTHON = "rosidl_generator_c", "rosidl_generator_py"
# Generators that write headers.
_HEADERS = (
    "rosidl_generator_c",
    "rosidl_typesupport_introspection_c",
    "rosidl_typesupport_fastrtps_c",
)
# Each library with the libraries of ROS that it needs; the generator of its name makes its code.
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
    """A generator or the compiler has failed; the text is its command and output."""


@dataclass(frozen=True)
class Compilers:
    """The programs, and the folders of the headers of Python and NumPy."""

    c: str
    cpp: str
    python_headers: Sequence[Path]

    @classmethod
    def here(cls) -> Compilers:
        """The compilers of this machine.

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
class _Builder:
    """Builds one package with rosidl's generators and gcc, as CMake does for a release.

    The package is built in a draft, which gets its name when it is whole.
    """

    build: PackageBuild
    workspaces: Workspaces
    compilers: Compilers
    progress: Progress
    environment: Mapping[str, str]

    @property
    def _name(self) -> str:
        return self.build.package.name

    @property
    def _prefix(self) -> Path:
        """The draft, which gets ``lib``, ``include``, ``python`` and ``share``."""
        return self.build.built.draft

    @property
    def _source(self) -> Path:
        return self._prefix / "source"

    def _generated(self, generator: str) -> Path:
        return generation.generated(self._source, generator, self._name)

    def _library(self, kind: str) -> Path:
        return self._prefix / "lib" / f"lib{self._name}__{kind}.so"

    def run(self) -> None:
        """Build the package, or wait until another program has built it.

        Raises:
            EnvironmentFault: if it cannot be built; only a log is left of it then.
        """
        built = self.build.built
        try:
            text = f"waiting for another program that builds {self._name}"
            built.build(self._make, lambda: self.progress.step(text))
        except OSError as error:
            raise EnvironmentFault(
                f"message package '{self._name}' cannot be built in {built.folder.parent}"
                f" ({error.strerror or error}): make room (df -h), or set XDG_CACHE_HOME"
            ) from error

    def _make(self) -> None:
        package, built = self.build.package, self.build.built
        if built.is_there:  # another program has built it meanwhile
            return
        self.progress.step(f"building {package.name}: {package.summary} ({package.folder})")
        shutil.rmtree(self._prefix, ignore_errors=True)
        try:
            self._source.mkdir(parents=True)
            self._generate()
            self._compile()
            self._install()
            shutil.rmtree(self._source)
            if built.folder != self.workspaces.installed(package.name):
                raise EnvironmentFault(
                    f"message package '{package.name}' was changed while it was built: start again"
                )
            self._prefix.rename(built.folder)
            built.log.unlink(missing_ok=True)
        except CompilationError as error:
            built.log.write_text(str(error), "utf-8")
            rows = [row.strip() for row in str(error).splitlines() if row.strip()]
            errors = [row for row in rows if re.search(r"\berror: ", row)]
            cause = (errors or rows[-1:])[0][:300]  # of a generator, the last line tells most
            raise EnvironmentFault(
                f"message package '{package.name}' cannot be built: {cause} (log: {built.log})"
            ) from error
        finally:
            shutil.rmtree(self._prefix, ignore_errors=True)

    def _generate(self) -> None:
        package, ros = self.build.package, self.workspaces.ros
        shares = {name: str(ros.share(name)) for name in ros.message_packages()}
        shares |= {need.package: str(need.share) for need in self.build.needs}
        order = generation.Order(
            package.name,
            str(package.folder),
            [file.as_posix() for file in package.files],
            str(self._source),
            str(ros.prefix),
            shares,
        )
        # By its path and isolated: it needs nothing of NeuROS, and nothing that PYTHONPATH names.
        # Generators open some files in the encoding of the locale, which may not be UTF-8.
        command = [sys.executable, "-I", "-X", "utf8", generation.__file__]
        self._run(command, json.dumps(order))

    def _compile(self) -> None:
        """Make the libraries of the package, and its module for Python."""
        sources = [f for kind in _LIBRARIES for f in sorted(self._generated(kind).rglob("*.c*"))]
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            objects = dict(zip(sources, pool.map(self._object, sources), strict=True))
        others = self._others()
        (self._prefix / "lib").mkdir(parents=True)
        entry = f"_{self._name}_s.ep."
        built = {need.package: need.folder for need in self.build.needs}
        ros = self.workspaces.ros.lib
        for kind, needs in _LIBRARIES.items():
            folder = self._generated(kind)
            own = [o for s, o in objects.items() if folder in s.parents and entry not in s.name]
            libraries = [self._library(_TO_C)] if kind != _TO_C else []
            libraries += [
                (built[other] / "lib" if other in built else ros) / f"lib{other}__{which}.so"
                for other in sorted(others)
                for which in dict.fromkeys([kind, _TO_C])
            ]
            libraries += [ros / f"lib{name}.so" for name in needs]
            out = self._library(kind)
            options = [_UNRESOLVED] if kind == _TO_PYTHON else []
            inputs = [*own, *(library for library in libraries if library.exists())]
            self._link(
                self.compilers.cpp, out, inputs, [*options, f"-Wl,-soname,{out.name}"], "$ORIGIN"
            )
        # The module brings all libraries along: ROS opens some of them by their names, and finds
        # those that are open already.
        out = self._prefix / "python" / self._name / f"{self._name}_s__rosidl_typesupport_c.abi3.so"
        out.parent.mkdir(parents=True)
        inputs = [o for s, o in objects.items() if s.name.startswith(entry)]
        inputs += map(self._library, _LIBRARIES)
        options = ["-Wl,--no-as-needed", _UNRESOLVED]
        self._link(self.compilers.c, out, inputs, options, "$ORIGIN/../../lib")

    def _object(self, source: Path) -> Path:
        out = source.with_suffix(f"{source.suffix}.o")
        include = self.workspaces.ros.include
        own = [self._generated(kind).parent for kind in _HEADERS]
        others = [need.folder / "include" / need.package for need in self.build.needs]
        # In ROS the headers of a package are in a folder of its name twice; fastcdr has one.
        ros = [include, *sorted(p for p in include.iterdir() if p.is_dir())]
        python: list[str] = []
        if self._generated(_TO_PYTHON) in source.parents:
            python = ["-include", str(_ABI)]
            ros = [*self.compilers.python_headers, *ros]
        is_c = source.suffix == ".c"
        command = [self.compilers.c, *_C] if is_c else [self.compilers.cpp, *_CPP]
        includes = [*(f"-I{folder}" for folder in own), *(f"-isystem{p}" for p in (*others, *ros))]
        self._run([*command, *includes, *python, "-c", str(source), "-o", str(out)])
        return out

    def _link(
        self, compiler: str, out: Path, inputs: Iterable[Path], options: Iterable[str], lib: str
    ) -> None:
        """Link a library.

        Args:
            lib: the folder ``lib`` of this package, seen from the library: there it finds others,
                and by the path from there those of other packages of workspaces.
        """
        folders = [need.folder for need in self.build.needs]
        search = [lib, *(f"{lib}/../../{folder.name}/lib" for folder in folders)]
        linked = [self._prefix / "lib", self.workspaces.ros.lib, *(f / "lib" for f in folders)]
        command = [compiler, *_LINK, *options, "-o", str(out), *map(str, inputs)]
        command += [f"-Wl,-rpath,{':'.join(search)}"]
        self._run([*command, *(f"-Wl,-rpath-link,{folder}" for folder in linked)])

    def _others(self) -> set[str]:
        """The packages that the messages refer to, with what these refer to."""
        others = {name for file in self.build.package.files for name in _IMPLIED[file.suffix]}
        for file in self._generated(generation.DESCRIPTIONS).rglob("*.json"):
            hashes = json.loads(file.read_text("utf-8"))["type_hashes"]
            others |= {each["type_name"].partition("/")[0] for each in hashes}
        return others - {self._name}

    def _install(self) -> None:
        """Copy what was generated to the folders of a ROS distribution."""
        package, prefix = self.build.package, self._prefix
        share, python = prefix / "share" / package.name, prefix / "python" / package.name
        for generator in (generation.INTERFACES, generation.DESCRIPTIONS):
            _copy(self._generated(generator), share, {".idl", ".json"})
        for file in (Path(MANIFEST), *package.files):
            shutil.copyfile(package.folder / file, share / file)
        for generator in _HEADERS:
            include = prefix / "include" / package.name / package.name
            _copy(self._generated(generator), include, {".h"})
        _copy(self._generated(_TO_PYTHON), python, {".py"})
        (python / "__init__.py").touch()
        index = prefix / "share" / "ament_index" / "resource_index" / "packages"
        index.mkdir(parents=True)
        (index / package.name).touch()

    def _run(self, command: Sequence[str], given: str = "") -> None:
        """Run a generator or compiler; ``given`` is its standard input.

        Raises:
            CompilationError: if it fails.
        """
        done = subprocess.run(
            command,
            cwd=self._source,
            env=self.environment,
            input=given,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            check=False,
        )
        if done.returncode:
            raise CompilationError(f"{' '.join(command)}\n{done.stdout}{done.stderr}")


def _copy(source: Path, target: Path, suffixes: set[str]) -> None:
    for file in source.rglob("*"):
        if file.suffix in suffixes:
            out = target / file.relative_to(source)
            out.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, out)
