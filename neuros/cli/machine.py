"""``neuros build``, ``containers``, ``doctor``, ``benchmark``, ``reproduce``: for this machine."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from contextlib import ExitStack, closing
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.backends.containers import OWN_FOLDER, STANDARD
from neuros.caching import cache_root
from neuros.cli.common import JSON, add_format, print_json, show_warnings
from neuros.distribution import ROOT
from neuros.errors import EnvironmentFault, ProjectError, UsageError
from neuros.installation.command import add_build_options

if TYPE_CHECKING:
    from neuros.backends.containers import Recipe


_CONTAINERS_EPILOG = """\
exit codes:
  0    done
  2    wrong usage
  3    invalid project
  4    no engine, or an image cannot be built: nothing half-built gets a name
  130  ended by Ctrl+C
"""
_DOCTOR_EPILOG = """\
exit codes:
  0    nothing is wrong
  4    something is wrong: lines that begin with PROBLEM say what, and what to do
"""


def add_build(build: argparse.ArgumentParser) -> None:
    build.description = (
        "Build the message packages of a workspace, and NeuROS's own, where they are not built"
        " yet. `neuros launch` does that, too."
    )
    build.epilog = (
        "exit codes: 0 all are built, 2 there is no such package, 3 a file has mistakes (listed"
        " with their lines), 4 there is no compiler, or it fails"
    )
    build.add_argument("packages", nargs="*", metavar="PACKAGE", help="these only (default: all)")
    build.add_argument(
        "-p",
        "--project",
        metavar="PROJECT",
        help="build the workspace beside this project's file (default: ./workspace)",
    )
    # For install.py: a machine without a compiler can do all the rest.
    build.add_argument("--if-compiler", action="store_true", help=argparse.SUPPRESS)
    build.set_defaults(command=_build)


def _build(options: argparse.Namespace) -> int:
    from neuros.api.loading import workspaces_of
    from neuros.cli.environments import build_messages
    from neuros.distribution import WORKSPACE
    from neuros.messages.needed import Compilers, Messages
    from neuros.project.suggest import did_you_mean

    project = Path(options.project or os.curdir)
    if not project.exists():
        raise UsageError(f"build: there is no project {project}")
    workspaces = workspaces_of(project)
    for name in options.packages:
        if name not in workspaces.packages and not workspaces.problems:
            hint = did_you_mean(name, workspaces.packages) or "it needs a package.xml and msg/*.msg"
            raise UsageError(f"build: no workspace has a message package '{name}' ({hint})")
    messages = Messages(workspaces, options.packages or workspaces.packages)
    if problems := [*messages.problems(), *workspaces.problems]:
        raise ProjectError(problems)
    show_warnings(messages.doubts())
    if options.if_compiler and not messages.is_made:
        try:
            Compilers.here()
        except EnvironmentFault as fault:
            print(f"message packages are not built: {fault}")
            return 0
    if ended := build_messages(messages):
        return ended
    for built in messages.built:
        print(f"messages of {built.package} are built: {built.folder}")
    if not messages.built:
        folder = project if project.is_dir() else project.parent
        print(f"no message packages in {folder / 'workspace'} and {WORKSPACE}")
    return 0


def add_containers(containers: argparse.ArgumentParser) -> None:
    containers.description = "Build, list and remove the images that nodes run in."
    containers.epilog = _CONTAINERS_EPILOG
    actions = containers.add_subparsers(title="actions", metavar="ACTION", required=True)
    build = actions.add_parser("build", help="build what is missing or out of date")
    build.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="a container, an image of your own, or a project (folder or file), for all containers"
        f" of its nodes (default: {' '.join(STANDARD)})",
    )
    add_build_options(build, build)
    build.add_argument(
        "--build-arg",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a build argument of the Dockerfiles, such as VARIANT=cuda for neuros_tensorflow",
    )
    build.add_argument(
        "--if-engine",
        action="store_true",
        help="if there is no Docker engine, say so, build nothing, and end with exit code 0",
    )
    build.set_defaults(command=_build_images)
    show = actions.add_parser("list", aliases=["ls"], help="show NeuROS's images")
    add_format(show)
    show.set_defaults(command=_list_images)
    remove = actions.add_parser("remove", help="remove images that NeuROS has built")
    remove.add_argument("names", nargs="*", metavar="NAME", help="containers (default: all)")
    remove.set_defaults(command=_remove_images)


def _build_images(options: argparse.Namespace) -> int:
    from neuros.backends.containers import find_recipe
    from neuros.backends.docker.building import ImageBuilder, Surroundings, served
    from neuros.backends.docker.engine import connect, require_program
    from neuros.installation.progress import Progress

    bases = dict(_pair(text, "neuros_python") for text in options.base_image)
    arguments = dict(_pair(text, None) for text in options.build_arg)
    recipes: list[Recipe] = []
    images: list[str] = []  # without a recipe
    for name in options.names or STANDARD:
        for container, project_folder in _containers(name):
            if recipe := find_recipe(container, project_folder):
                recipes.append(recipe)
            elif container not in images:
                images.append(container)
    wheelhouse = _file_or_folder(options.wheelhouse, "--wheelhouse", is_folder=True)
    bundle = _file_or_folder(options.ca_bundle, "--ca-bundle", is_folder=False)
    with ExitStack() as stack:
        try:
            engine = stack.enter_context(closing(connect(timeout_s=None)))
            require_program()
        except EnvironmentFault as fault:
            if not options.if_engine:
                raise
            print(f"no containers are built, so projects run as processes: {fault}")
            return 0
        wheels = stack.enter_context(served(wheelhouse)) if wheelhouse else ""
        around = Surroundings(engine, os.environ, bundle, wheels)
        progress, logs = Progress(sys.stdout), cache_root(os.environ) / "builds"
        builder = ImageBuilder(
            engine, around, progress, logs, bases=bases, arguments=arguments, pull=options.pull
        )
        builder.build(recipes)
        for image in images:
            builder.add_to(image)
    return 0


def _list_images(options: argparse.Namespace) -> int:
    from neuros.backends.containers import names_in
    from neuros.backends.docker.engine import connect
    from neuros.backends.docker.images import inventory

    with closing(connect()) as engine:
        images = inventory(engine)
    missing = [
        name for name in names_in(OWN_FOLDER) if all(image.container != name for image in images)
    ]
    if options.format == JSON:
        print_json({"built": images, "not_built": missing})
        return 0
    for image in images:
        state = "" if image.is_current else "  (its recipe has changed)"
        size = f"{image.size_bytes / 1e6:6.0f} MB"
        print(f"{image.container:20} {size}  Python {image.python}  {image.tags[0]}{state}")
    for name in missing:
        print(f"{name:20} not built")
    return 0


def _remove_images(options: argparse.Namespace) -> int:
    from neuros.backends.docker.engine import connect
    from neuros.backends.docker.images import remove_images

    with closing(connect()) as engine:
        has_removed = False
        for tag in remove_images(engine, options.names):
            print(f"removed {tag}")
            has_removed = True
    if not has_removed:
        print("NeuROS has built no images: there is nothing to remove")
    return 0


def _containers(name: str) -> list[tuple[str, Path | None]]:
    """The containers of a name, folder or project, each with the folder of its project."""
    from neuros.api.loading import workspaces_of
    from neuros.backends.containers import names_in
    from neuros.distribution import WORKSPACE
    from neuros.project.load import load_project

    path = Path(name).absolute()
    if name in names_in(OWN_FOLDER) or not path.exists():
        return [(name, None)]
    if path.is_dir() and path.name in names_in(path.parent):
        return [(path.name, path.parent.parent)]
    project = load_project(path, workspace=WORKSPACE, packages=workspaces_of(path)).project
    return [(node.container, project.folder) for node in project.nodes]


def _pair(text: str, key: str | None) -> tuple[str, str]:
    """``NAME=IMAGE``; with a ``key`` to assume, ``IMAGE`` is enough."""
    name, separator, value = text.partition("=")
    if separator and name and value:
        return name, value
    if key is None or separator or not text:
        raise UsageError(f"'{text}' is not KEY=VALUE")
    return key, text


def _file_or_folder(text: str | None, option: str, *, is_folder: bool) -> Path | None:
    """The path of an option. Raises ``UsageError`` if it does not exist."""
    if text is None:
        return None
    path = Path(text).absolute()
    if not (path.is_dir() if is_folder else path.is_file()):
        raise UsageError(f"{option} {text}: there is no such {'folder' if is_folder else 'file'}")
    return path


def add_doctor(doctor: argparse.ArgumentParser) -> None:
    doctor.description = (
        "Check that this machine has what runs need, then send packets between two nodes on each"
        " back end of this machine, to prove that they arrive."
    )
    doctor.epilog = _DOCTOR_EPILOG
    doctor.add_argument(
        "--no-delivery", action="store_true", help="only look: start no nodes and no containers"
    )
    doctor.add_argument(
        "--deployment",
        type=Path,
        metavar="FILE",
        help="check the machines of a deployment file, too, and that packets arrive between each of"
        " them and this one",
    )
    add_format(doctor)
    doctor.set_defaults(command=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    from neuros.doctor.checks import findings
    from neuros.ports import FindingState
    from neuros.registry import DEPLOYMENTS

    found, proves = [], not options.no_delivery
    looked_at = findings(os.environ, proves=proves)
    if options.deployment is not None:
        machines = DEPLOYMENTS.load("machines")
        looked_at = chain(looked_at, machines.checks(options.deployment, proves=proves))
    for finding in looked_at:
        found.append(finding)
        if options.format != JSON:
            print(finding, flush=True)  # the proofs take seconds
    if options.format == JSON:
        print_json(found)
    return 4 if any(finding.state is FindingState.BAD for finding in found) else 0


# ---------------------------------------------------------------------- programs of the checkout
#
# ``neuros benchmark`` and ``neuros reproduce``, whose options and programs are in the checkout.


_OPTIONS = "benchmarks.options"


def add_benchmark(benchmark: argparse.ArgumentParser) -> None:
    _add_options(benchmark, "add_benchmark")


def add_reproduce(reproduce: argparse.ArgumentParser) -> None:
    _add_options(reproduce, "add_reproduce")


def _add_options(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the options that the checkout defines.

    Raises:
        EnvironmentFault: where neuros was installed without a checkout.
    """
    if not (ROOT / _OPTIONS.replace(".", "/")).with_suffix(".py").is_file():
        raise EnvironmentFault(
            f"there are no benchmarks in {ROOT}: they are part of the source checkout and not of"
            " the package; clone it, run ./install.py there, and use its .venv/bin/neuros"
        )
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    getattr(importlib.import_module(_OPTIONS), name)(parser)
