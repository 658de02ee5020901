"""``install.py``: make ``.venv``, install NeuROS into it, and build what else was asked for."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.installation.environment import Environment, extras_of
from neuros.installation.machine import Machine, clean_environment, install_opengl, offscreen_opengl
from neuros.installation.packages import explain_failure, pip_settings
from neuros.installation.progress import Progress

STANDARD_EXTRAS = ("mujoco", "nest", "plot")
DEVELOPER_EXTRAS = ("dev", "docs")


def main(arguments: Sequence[str], root: str) -> int:
    """Run ``install.py``; returns its exit code (0, 1 a test failed, 4 or 130).

    Raises:
        SystemExit: from argparse, with 2 for wrong arguments and 0 for ``--help``.
    """
    folder, progress = Path(root), Progress(sys.stdout)
    options = parse_options(arguments, extras_of((folder / "pyproject.toml").read_text("utf-8")))
    try:
        Machine.here().require_support()
        environment = Environment(folder, options.extras, progress, pip_settings(options))
        if not (options.yes or environment.is_installed or _agrees(environment.folder)):
            return 130
        if options.test:
            prepare_tests(folder)
        environment.install()
        if code := build_messages(environment.python, folder):
            progress.fail("install.py: NeuROS is installed, but not all message packages are built")
            return code
        if not options.no_containers and (code := build_containers(environment.python, options)):
            progress.fail("install.py: NeuROS is installed, but not all images were built")
            return code
        if options.docs and (code := build_documentation(environment.python, folder)):
            progress.fail("install.py: NeuROS is installed, but its documentation was not built")
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
    for row in _next_steps(folder, environment.extras):
        progress.step(row)
    return 0


def parse_options(arguments: Sequence[str], known: Sequence[str]) -> argparse.Namespace:
    """What the command line of ``install.py`` says; ``known`` are the extras that there are.

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
        "--test",
        action="store_true",
        help="then run all checks and tests, for which root installs packages of Debian",
    )
    _add_container_options(parser)
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


def _add_container_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "containers", "Where Docker is, the images that nodes run in are built, too."
    )
    which = group.add_mutually_exclusive_group()
    which.add_argument(
        "--containers",
        nargs="+",
        metavar="NAME",
        help="build these: NeuROS's, images of your own, or all that a project (a folder) needs"
        " (default: neuros_python, neuros_mujoco, neuros_nest)",
    )
    which.add_argument("--no-containers", action="store_true", help="build none")
    group.add_argument(
        "--base-image",
        action="append",
        default=[],
        metavar="[NAME=]IMAGE",
        help="begin the image of container NAME (default: neuros_python) from IMAGE",
    )
    group.add_argument(
        "--pull", action="store_true", help="ask for the newest version of base images"
    )
    offline = parser.add_argument_group("where PyPI cannot be reached as usual")
    offline.add_argument(
        "--wheelhouse",
        metavar="DIR",
        help="take all Python packages, also for containers, from a folder of wheels",
    )
    offline.add_argument(
        "--ca-bundle", metavar="FILE", help="certificates (PEM) to trust, also in containers"
    )


def prepare_tests(root: Path) -> None:
    """Install what the tests need of the operating system; who is not root, reads what it is."""
    subprocess.call([sys.executable, str(root / "tests" / "needs.py"), "--install"])


def _agrees(folder: Path) -> bool:
    """Ask once, on a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        return True
    answer = input(f"This fills {folder} (0.6 GB) with packages from PyPI. Go on? [Y/n] ")
    return answer.strip().lower() in ("", "y", "yes")


def _next_steps(root: Path, extras: Sequence[str]) -> list[str]:
    rows = []
    if not offscreen_opengl():
        rows.append(f"simulated cameras need a graphics library: {install_opengl()}")
    example = "4_neurorobotics/whiskeye" if "nest" in extras else "3_physics_simulation/elevator"
    is_here = Path.cwd() == root
    launch = "./launch.py examples" if is_here else f"{root / 'launch.py'} {root / 'examples'}"
    return [*rows, f"installed; the next command: {launch}/{example}"]


def build_containers(python: Path, options: argparse.Namespace) -> int:
    """Build what is missing or out of date; returns an exit code.

    Where nothing was asked for by name, a machine without Docker gets a line about it, and that is
    all.
    """
    command = [str(python), "-m", "neuros.cli", *build_arguments(options)]
    return subprocess.call(command, env=clean_environment(os.environ))


def build_messages(python: Path, root: Path) -> int:
    """Build the message packages of NeuROS's workspace; returns an exit code.

    A machine without a C compiler gets a line about it, and that is all.
    """
    command = [str(python), "-m", "neuros.cli", "build", "--if-compiler"]
    return subprocess.call(command, cwd=root, env=clean_environment(os.environ))


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


def build_documentation(python: Path, root: Path) -> int:
    """Build ``docs/build/html``; returns an exit code. What is wrong is said by Sphinx."""
    command = [str(python), str(root / "docs" / "make.py")]
    return subprocess.call(command, env=clean_environment(os.environ))
