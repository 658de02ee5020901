"""The back end ``charliecloud``: each node in an unpacked image, without a daemon and without root.

A node is a process of this machine with another root folder: ``ch-run`` makes it with a user
namespace and becomes the node. ``ch-convert`` makes the image, a folder, from an image that Docker
or podman has built.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neuros.backends.containers import bare_name
from neuros.backends.node_command import NodeProcess, node_process
from neuros.backends.process_launchers import ProcessDeployment, ProcessLauncher
from neuros.distribution import libraries
from neuros.errors import EnvironmentFault
from neuros.options import Option
from neuros.ports import BackEnd, Deployment, Finding, Launcher, NodeProgram
from neuros.project.model import Node, NodeFile, Project

_RUNNER = "ch-run"
_INSTALL = "apt-get install charliecloud, or ask those who run the cluster"
_PYTHON = Path("/opt/neuros/bin/python")
"""The Python of every image that is built from a recipe."""
_LIBRARY = Path("/neuros/lib")
_FOLDER = "~/.local/share/neuros/images"
_PROBE_S = 30.0
_USER = {"USER": "neuros"}  # ch-run requires a name
# The launcher's Python, or a module file, sets these, and they name the wrong libraries.
_UNSET = ("PYTHONHOME", "PYTHONPATH", "LD_LIBRARY_PATH", "LD_PRELOAD", "VIRTUAL_ENV")


class Charliecloud(BackEnd):
    """The back end; no run chooses it by itself."""

    name = "charliecloud"
    place = "an unpacked image"
    has_own_pythons = True
    options = (
        Option(
            ("--image-folder",),
            "the folder with unpacked images, each named as its container",
            default=_FOLDER,
            variable="NEUROS_IMAGE_FOLDER",
            metavar="FOLDER",
            page="../extensions/neuros-cluster/README.md#charliecloud",
        ),
    )

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        _require_runner(os.environ)
        folder = Path(options["image_folder"]).expanduser().absolute()
        images = {node.container: _image(folder, node.container) for node in nodes}
        missing = [_missing(name, path) for name, path in images.items() if not _is_image(path)]
        if missing:
            raise EnvironmentFault("\n".join(missing))
        _try_image(next(iter(images.values())))
        return _Images(nodes, images)

    def checks(self, environ: Mapping[str, str]) -> Iterable[Finding]:
        (option,) = self.options
        folder = Path(option.value(None, environ)).expanduser()
        try:
            _require_runner(environ)
        except EnvironmentFault as fault:
            yield Finding.absent("Charliecloud", str(fault))
            return
        images = [each for each in sorted(folder.glob("*")) if _is_image(each)]
        if not images:
            yield Finding.absent("Charliecloud", f"no unpacked images in {folder}")
            return
        try:
            _try_image(images[0])
        except EnvironmentFault as fault:
            yield Finding.bad("Charliecloud", str(fault))
            return
        names = ", ".join(each.name for each in images)
        yield Finding.good("Charliecloud", f"images in {folder}: {names}")


BACK_END = Charliecloud()


class _Images(ProcessDeployment):
    """A process per node, with ``ch-run`` before its command."""

    def __init__(self, nodes: Sequence[Node], images: Mapping[str, Path]) -> None:
        super().__init__(nodes)
        self._images = images

    def launcher(self, program: NodeProgram) -> Launcher:
        return ProcessLauncher(program, self._process_of)

    def _process_of(
        self, program: NodeProgram, node: NodeFile, environment: Mapping[str, str]
    ) -> NodeProcess:
        program = replace(program, pythons={node.node.name: _PYTHON})
        process = node_process(program, node, environment)
        return _inside(process, node, self._images[node.node.container])

    def record(self) -> Mapping[str, Any]:
        return {"charliecloud": {name: str(path) for name, path in self._images.items()}}


def _inside(process: NodeProcess, node: NodeFile, image: Path) -> NodeProcess:
    """The process in an image with the folders of the run mounted under their own paths."""
    folders = node.folders
    seen = {folder: _LIBRARY / name for name, folder in libraries().items()}
    seen |= {path: path for path in (folders.project, folders.workspace, folders.run)}
    seen |= {python: python for python in node.messages}
    binds: list[str] = []
    for here, there in sorted(seen.items(), key=lambda pair: len(pair[1].parts)):
        if here.is_dir():  # an installed NeuROS has no workspace
            # The image is mounted read-only, so ch-run cannot make the folder.
            inside = image / there.relative_to("/")
            try:
                inside.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise EnvironmentFault(
                    f"{inside}: {error.strerror}: the image needs this folder, to see {there}"
                    " there; its owner can make it"
                ) from error
            binds.append(f"--bind={here}:{there}")
    start = [_RUNNER, "--set-env", *binds, f"--cd={process.folder}", str(image), "--"]
    given = {key: value for key, value in process.environment.items() if key not in _UNSET}
    path = os.pathsep.join([*map(str, node.messages), str(_LIBRARY)])
    environment = {**_USER, **given, "HOME": "/tmp", "PYTHONPATH": path}
    environment["XDG_CACHE_HOME"] = "/tmp/.cache"  # the launcher's is not mounted
    return replace(
        process,
        command=[*start, *process.command],
        node_program=[*start, *process.node_program],
        environment=environment,
    )


def _image(folder: Path, container: str) -> Path:
    return folder / bare_name(container).replace("/", "%").replace(":", "+")


def _is_image(path: Path) -> bool:
    return os.path.lexists(path / _PYTHON.relative_to("/"))


def _missing(container: str, path: Path) -> str:
    if path.is_dir():
        return f"{path} is no image that can run nodes: it has no {_PYTHON}; build it with NeuROS"
    return (
        f"container '{container}': there is no unpacked image {path}: ch-convert -i docker"
        f" {container} {path}, on a machine that has built it"
    )


def _require_runner(environ: Mapping[str, str]) -> None:
    if shutil.which(_RUNNER, path=environ.get("PATH")) is None:
        raise EnvironmentFault(f"Charliecloud is not installed ({_RUNNER} on PATH): {_INSTALL}")


def _try_image(image: Path) -> None:
    """Start a program in an image: a machine may forbid user namespaces."""
    try:
        done = subprocess.run(
            [_RUNNER, str(image), "--", "/bin/true"],
            env={**_USER, **os.environ},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PROBE_S,
            check=False,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise EnvironmentFault(f"nothing can be started in {image}: {error}") from error
    if done.returncode:
        raise EnvironmentFault(
            f"nothing can be started in {image}: {done.stderr.strip()}: does this machine allow"
            " user namespaces? (unshare --user true)"
        )
