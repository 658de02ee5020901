"""``install.py``: make ``.venv``, install NeuROS into it, and build what else was asked for."""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType

from neuros.distribution import python_command
from neuros.errors import EnvironmentFault
from neuros.installation.machine import (
    NEWEST,
    NEWEST_FOR_NEST,
    OLDEST,
    Machine,
    answer_of,
    clean_environment,
    dotted,
    explain_missing_library,
    install_opengl,
    offscreen_opengl,
)
from neuros.installation.packages import (
    LOCKS,
    explain_failure,
    install,
    make_venv,
    pip_settings,
)
from neuros.installation.progress import Progress

STANDARD_EXTRAS = ("mujoco", "nest", "plot", "analysis", "cluster", "dashboard", "learn", "robots")
DEVELOPER_EXTRAS = ("dev", "docs")
_PROOF_TIMEOUT_S = 180.0
_TITLES = {"": "ROS 2", "mujoco": "MuJoCo", "nest": "NEST", "plot": "Matplotlib"}


def main(arguments: Sequence[str], root: str) -> int:
    """Run ``install.py``; returns its exit code (0, 1 a test failed, 4 or 130).

    Raises:
        SystemExit: from argparse, with 2 for wrong arguments and 0 for ``--help``.
    """
    folder, progress = Path(root), Progress(sys.stdout)
    options = parse_options(arguments, extras_of((folder / "pyproject.toml").read_text("utf-8")))
    try:
        Machine.here().require_support()
        environment = Environment(
            folder, options.extras, progress, pip_settings(options), newest=options.newest
        )
        if not (options.yes or environment.python_version() or _agrees(environment.folder)):
            return 130
        if options.test:
            prepare_tests(folder)
        environment.install()
        if code := build(environment.python, folder, options, progress):
            return code
        if options.test:
            progress.step("installed; running the checks and tests")
            return subprocess.call([str(environment.python), str(folder / "tests" / "run")])
    except EnvironmentFault as fault:
        progress.fail(f"install.py: {fault}")
        return 4
    except OSError as error:
        progress.fail(f"install.py: {explain_failure(str(error)) or error}")
        return 4
    except KeyboardInterrupt:
        progress.fail("install.py: interrupted; run it again to go on")
        return 130
    if not offscreen_opengl():
        progress.step(f"simulated cameras need a graphics library: {install_opengl()}")
    has_nest = "nest" in environment.extras
    example = "4_neurorobotics/whiskeye" if has_nest else "3_physics_simulation/elevator"
    is_here = Path.cwd() == folder
    launch = "./launch.py examples" if is_here else f"{folder / 'launch.py'} {folder / 'examples'}"
    progress.step(f"installed; the next command: {launch}/{example}")
    return 0


def parse_options(arguments: Sequence[str], known: Sequence[str]) -> argparse.Namespace:
    """Parse the command line of ``install.py``; ``known`` are the extras of the project.

    Raises:
        SystemExit: from argparse, with 2 for wrong arguments and 0 for ``--help``.
    """
    further = [extra for extra in known if extra not in STANDARD_EXTRAS]
    parser = argparse.ArgumentParser(
        prog="install.py",
        description="Make .venv and install NeuROS into it, with MuJoCo, NEST and Matplotlib;"
        " where there is a Docker engine, build the images that nodes run in.",
        epilog="Exit codes: 0 installed, 1 a test failed, 2 usage, 4 something is missing on this "
        "machine, 130 cancelled.",
    )
    parser.add_argument("-y", "--yes", action="store_true", help="ask nothing")
    parser.add_argument(
        "--extras", metavar="A,B", default="", help=f"install more: {', '.join(further)}"
    )
    parser.add_argument("--dev", action="store_true", help="the same as --extras dev,docs")
    parser.add_argument(
        "--docs", action="store_true", help="install what builds the documentation, and build it"
    )
    parser.add_argument(
        "--newest",
        action="store_true",
        help="install the newest packages that pyproject.toml allows (default: exactly those of"
        f" the lock files in {LOCKS}/, whose hashes are checked)",
    )
    parser.add_argument(
        "--test",
        action="store_true",
        help="then run all checks and tests; root first installs the Debian packages for them",
    )
    group = parser.add_argument_group(
        "containers", "If there is a Docker engine, the images that nodes run in are built, too."
    )
    which = group.add_mutually_exclusive_group()
    which.add_argument(
        "--containers",
        nargs="+",
        metavar="NAME",
        help="images to build: NeuROS's, your own, or all that a project (a folder) needs"
        " (default: neuros_python, neuros_mujoco, neuros_nest)",
    )
    which.add_argument("--no-containers", action="store_true", help="build none")
    offline = parser.add_argument_group(
        "where PyPI cannot be reached as usual", "These are for containers, too."
    )
    add_build_options(group, offline)
    options = parser.parse_args(arguments)
    extras = {*STANDARD_EXTRAS, *(name for name in options.extras.split(",") if name)}
    extras.update(DEVELOPER_EXTRAS if options.dev or options.test else ())
    extras.update(("docs",) if options.docs else ())
    if unknown := sorted(extras - set(known)):
        parser.error(f"no such extra: {', '.join(unknown)} (there are {', '.join(known)})")
    options.extras = sorted(extras)
    if options.wheelhouse and not Path(options.wheelhouse).is_dir():
        parser.error(f"--wheelhouse {options.wheelhouse}: there is no such folder")
    if options.ca_bundle and not Path(options.ca_bundle).is_file():
        parser.error(f"--ca-bundle {options.ca_bundle}: there is no such file")
    return options


def add_build_options(
    images: argparse._ActionsContainer, offline: argparse._ActionsContainer
) -> None:
    """The options that ``neuros containers build`` has, too."""
    images.add_argument(
        "--base-image",
        action="append",
        default=[],
        metavar="[NAME=]IMAGE",
        help="begin the image of container NAME (default: neuros_python) from IMAGE",
    )
    images.add_argument(
        "--pull", action="store_true", help="ask for the newest version of base images"
    )
    offline.add_argument(
        "--wheelhouse",
        metavar="DIR",
        help="take all Python packages from a folder of wheels; their versions and hashes need not"
        " be those of the lock files",
    )
    offline.add_argument("--ca-bundle", metavar="FILE", help="certificates (PEM) to trust")


def prepare_tests(root: Path) -> None:
    """Install the system packages for the tests; without the rights of root, print their names."""
    subprocess.call([sys.executable, str(root / "tests" / "needs.py"), "--install"])


def _agrees(folder: Path) -> bool:
    """Ask once, on a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        return True
    answer = input(f"This fills {folder} (0.6 GB) with packages from PyPI. Go on? [Y/n] ")
    return answer.strip().lower() in ("", "y", "yes")


def build(python: Path, root: Path, options: argparse.Namespace, progress: Progress) -> int:
    """Build messages, images and the documentation, as asked for; returns an exit code.

    Without a C compiler, or without Docker and a container named by the user, a line says so.
    """
    messages = ("build", "--if-compiler", "--project", str(root))
    steps = {
        "not all message packages are built": python_command("neuros.cli", *messages, python=python)
    }
    if not options.no_containers:
        images = build_arguments(options)
        steps["not all images were built"] = python_command("neuros.cli", *images, python=python)
    if options.docs:
        steps["its documentation was not built"] = [str(python), str(root / "docs" / "make.py")]
    for without, command in steps.items():
        if code := subprocess.call(command, env=clean_environment(os.environ)):
            progress.fail(f"install.py: NeuROS is installed, but {without}")
            return code
    return 0


def build_arguments(options: argparse.Namespace) -> Sequence[str]:
    """The options of ``neuros containers build`` for those of ``install.py``."""
    arguments = ["containers", "build", *(options.containers or ["--if-engine"])]
    for image in options.base_image:
        arguments += ["--base-image", image]
    if options.wheelhouse:
        arguments += ["--wheelhouse", options.wheelhouse]
    if options.ca_bundle:
        arguments += ["--ca-bundle", options.ca_bundle]
    return [*arguments, *(["--pull"] if options.pull else [])]


# Code that runs only where the libraries of an extra load; "" is NeuROS itself. It also compiles
# what runs import: to compile all packages takes three times as long as to install them.
_PROOFS = {
    "": (
        "import docker, rclpy, sensor_msgs.msg, tabulate, tqdm, neuros.cli.launch,"
        " neuros.node.process, neuros.recording.bag_writer;"
        " rclpy.utilities.get_rmw_implementation_identifier()"
    ),
    "mujoco": "import mujoco; mujoco.MjModel.from_xml_string('<mujoco/>')",
    "nest": "import nest; nest.Create('iaf_psc_alpha')",
    "plot": "import matplotlib.pyplot",
    "analysis": "import pandas",
}


def extras_of(pyproject: str) -> tuple[str, ...]:
    """The names of the optional dependencies in the text of ``pyproject.toml``.

    Python 3.10 has no TOML parser; the table is ours and its keys stand at the start of a line.
    """
    table = re.search(
        r"^\[project\.optional-dependencies\]$(.*?)(?=^\[|\Z)", pyproject, re.MULTILINE | re.DOTALL
    )
    return tuple(re.findall(r"^([\w-]+)\s*=", table.group(1), re.MULTILINE)) if table else ()


def remove_leftovers(package: Path) -> None:
    """Remove subfolders of a package that hold nothing but caches.

    An update of the checkout leaves them of packages that moved, and Python would import them.
    """
    for cache in sorted(package.rglob("__pycache__"), reverse=True):  # the innermost first
        if cache.parent != package and {*cache.parent.iterdir()} == {cache}:
            shutil.rmtree(cache.parent)


class Environment:
    """The virtual environment of a source tree.

    Args:
        extras: to install beside the core.
        pip_settings: are added to the environment of pip.
        newest: whether versions are the newest, not those of the lock files.

    Attributes:
        folder: ``.venv`` in the source tree.
        extras: without NEST where NEST has no packages for this Python.
    """

    def __init__(
        self,
        root: Path,
        extras: Sequence[str],
        progress: Progress,
        pip_settings: Mapping[str, str] = MappingProxyType({}),
        *,
        newest: bool = False,
    ) -> None:
        self.folder, self.extras = root / ".venv", tuple(extras)
        self._root, self._progress = root, progress
        self._pip_settings, self._newest = pip_settings, newest
        # Exists during an installation: an interrupted one leaves packages that only look whole.
        self._unfinished = self.folder / "neuros-unfinished"

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    def install(self) -> None:
        """Install missing packages and prove that they work.

        Raises:
            EnvironmentFault: with a sentence for the user.
        """
        if not os.access(self._root, os.W_OK):
            remedy = f"sudo chown -R $(id -un) {self._root}"
            raise EnvironmentFault(f"{self._root} cannot be written: {remedy}")
        remove_leftovers(self._root / "neuros")
        version = self.python_version()
        is_new = version is None
        version = version or self._make()
        if version > NEWEST_FOR_NEST and "nest" in self.extras:
            self.extras = tuple(extra for extra in self.extras if extra != "nest")
            self._progress.step(
                f"NEST is left out: it has no packages for Python {dotted(version)} yet "
                "(to have it, remove .venv and run install.py with Python 3.13 or older)"
            )
        self._fill()
        faults = self._prove()
        if faults and not is_new:
            # Files may be missing that uv believes to be there.
            self._progress.step(f"{faults[0]}; beginning anew")
            self._make()
            self._fill()
            faults = self._prove()
        if faults:
            raise EnvironmentFault(explain_missing_library("; ".join(faults)))
        self._unfinished.unlink(missing_ok=True)  # two installations may go on at once
        self.compile()

    def compile(self) -> None:
        """Compile NeuROS's modules, so that no start has to; the folder may become read-only.

        A module that cannot be compiled or written is no fault: Python compiles it at each start.
        """
        packages = map(str, [self._root / "neuros", *self._root.glob("extensions/*/neuros_*")])
        command = python_command("compileall", "-qq", "-j0", *packages, python=self.python)
        subprocess.run(command, env=clean_environment(os.environ), check=False)

    def python_version(self) -> tuple[int, int] | None:
        """The version of its Python, or ``None`` where ``.venv`` is absent or cannot be used."""
        if self._unfinished.exists():
            return None
        try:
            # A virtual environment that was moved or copied calls the programs of the old one.
            is_ours = str(self.folder) in (self.folder / "bin" / "pip").read_text("utf-8")[:1000]
        except (OSError, ValueError):
            return None
        answer = self._run("import sys, pip; print(*sys.version_info[:2])")
        if answer is None or answer.returncode:
            return None
        major, minor = map(int, answer.stdout.split())
        return (major, minor) if is_ours and OLDEST <= (major, minor) <= NEWEST else None

    def _make(self) -> tuple[int, int]:
        """Make ``.venv`` anew, empty, with the Python that runs this."""
        self._progress.step(f"making .venv with Python {platform.python_version()}")
        # Inside a virtual environment (even the one to be replaced) venv needs the base Python.
        base = getattr(sys, "_base_executable", sys.executable)
        command = python_command("venv", "--clear", str(self.folder), python=base)
        if why := make_venv(command, os.environ):
            shutil.rmtree(self.folder, ignore_errors=True)
            raise EnvironmentFault(f".venv cannot be made: {why}; then install.py again")
        return sys.version_info[:2]

    def _fill(self) -> None:
        self._unfinished.touch()
        environ = {**clean_environment(os.environ), **self._pip_settings}
        environ.setdefault("UV_COMPILE_BYTECODE", "0")
        install(self.python, self._root, self.extras, self._progress, environ, newest=self._newest)

    def _prove(self) -> list[str]:
        """Use each part in a process of its own; one sentence for each that fails."""
        self._progress.detail("importing what was installed")
        names = [name for name in _PROOFS if not name or name in self.extras]
        with ThreadPoolExecutor() as threads:
            answers = list(
                threads.map(lambda name: self._run(f"import neuros; {_PROOFS[name]}"), names)
            )
        faults = []
        for name, answer in zip(names, answers, strict=True):
            if answer is None or answer.returncode:
                said = f"no answer in {_PROOF_TIMEOUT_S:g} s"
                if answer is not None:
                    said = answer.stderr.strip() or f"exit code {answer.returncode}"
                faults.append(
                    f"{_TITLES.get(name, name)} does not import ({said.splitlines()[-1]})"
                )
        return faults

    def _run(self, code: str) -> subprocess.CompletedProcess[str] | None:
        """Run ``code`` in the Python of ``.venv``; ``None`` if it does not start or end in time."""
        # NEST fixes the number of its threads when it is imported. An empty variable is unset.
        further = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": ""}
        command = python_command(code=code, python=self.python)
        return answer_of(command, {**clean_environment(os.environ), **further}, _PROOF_TIMEOUT_S)
