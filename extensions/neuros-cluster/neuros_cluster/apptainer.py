"""The back end ``apptainer``: each node in an image file, without a daemon and without root.

A node is a process of this machine with another root folder: ``apptainer exec`` mounts the image
and becomes the node. ``apptainer build`` makes the image from one that Docker or podman has built.
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

_RUNNER = "apptainer"
_PYTHON = Path("/opt/neuros/bin/python")
"""The Python of every image that is built from a recipe."""
_LIBRARY = Path("/neuros/lib")
_PROBE_S = 60.0
# The launcher's Python, or a module file, sets these, and they name the wrong libraries.
_UNSET = ("PYTHONHOME", "PYTHONPATH", "LD_LIBRARY_PATH", "LD_PRELOAD", "VIRTUAL_ENV")


class Apptainer(BackEnd):
    """The back end; no run chooses it by itself."""

    name = "apptainer"
    place = "an image file"
    has_own_pythons = True
    options = (
        Option(
            ("--image-folder",),
            "the folder with images of Apptainer, CONTAINER.sif",
            default="~/.local/share/neuros/images",
            variable="NEUROS_IMAGE_FOLDER",
            metavar="FOLDER",
            page="../extensions/neuros-cluster/README.md#apptainer",
        ),
    )

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        _require_runner(os.environ)
        folder = Path(options["image_folder"]).expanduser().absolute()
        images = {node.container: _image(folder, node.container) for node in nodes}
        missing = [
            f"container '{name}': there is no image {path}: apptainer build {path}"
            f" docker-daemon:{name}:latest, on a machine that has built it with Docker"
            for name, path in images.items()
            if not path.exists()
        ]
        if missing:
            raise EnvironmentFault("\n".join(missing))
        for image in dict.fromkeys(images.values()):
            _try_image(image)
        return _Images(nodes, images)

    def checks(self, environ: Mapping[str, str]) -> Iterable[Finding]:
        (option,) = self.options
        folder = Path(option.value(None, environ)).expanduser()
        try:
            _require_runner(environ)
        except EnvironmentFault as fault:
            yield Finding.absent("Apptainer", str(fault))
            return
        images = sorted(folder.glob("*.sif"))
        if not images:
            yield Finding.absent("Apptainer", f"no images in {folder}")
            return
        try:
            _try_image(images[0])
        except EnvironmentFault as fault:
            yield Finding.bad("Apptainer", str(fault))
            return
        names = ", ".join(each.stem for each in images)
        yield Finding.good("Apptainer", f"images in {folder}: {names}")


BACK_END = Apptainer()


class _Images(ProcessDeployment):
    """A process per node, with ``apptainer exec`` before its command."""

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
        return {"apptainer": {name: str(path) for name, path in self._images.items()}}


def _inside(process: NodeProcess, node: NodeFile, image: Path) -> NodeProcess:
    """The process in an image with the folders of the run mounted under their own paths."""
    folders = node.folders
    seen = {folder: _LIBRARY / name for name, folder in libraries().items()}
    seen |= {path: path for path in (folders.project, folders.workspace, folders.run)}
    seen |= {python: python for python in node.messages}
    binds = [f"--bind={here}:{there}" for here, there in seen.items() if here.is_dir()]
    # The run folder would otherwise be the current folder or in the home of the user.
    options = ["--no-home", "--no-mount=cwd", f"--pwd={process.folder}", *binds]
    options += ["--nv"] if node.node.access.gpus else []
    # Apptainer sets some variables itself, HOME among them, so a program in the image sets these.
    path = os.pathsep.join([*map(str, node.messages), str(_LIBRARY)])
    inside = ["HOME=/tmp", f"PYTHONPATH={path}", "XDG_CACHE_HOME=/tmp/.cache"]
    start = [_RUNNER, "--quiet", "exec", *options, str(image), "/usr/bin/env", *inside]
    given = {key: value for key, value in process.environment.items() if key not in _UNSET}
    return replace(
        process,
        command=[*start, *process.command],
        node_program=[*start, *process.node_program],
        environment=given,
    )


def _image(folder: Path, container: str) -> Path:
    return folder / f"{bare_name(container).replace('/', '%').replace(':', '+')}.sif"


def _require_runner(environ: Mapping[str, str]) -> None:
    if shutil.which(_RUNNER, path=environ.get("PATH")) is None:
        raise EnvironmentFault(
            f"Apptainer is not installed ({_RUNNER} on PATH): https://apptainer.org, or ask those"
            " who run the cluster (module load apptainer)"
        )


def _try_image(image: Path) -> None:
    """Start the Python of an image: a machine may forbid user namespaces, or it is another one."""
    command = [_RUNNER, "--quiet", "exec", "--no-home", "--no-mount=cwd", str(image)]
    try:
        done = subprocess.run(
            [*command, str(_PYTHON), "-I", "-c", ""],
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
            f"{image} has no {_PYTHON} that starts: {done.stderr.strip()}: is it built from a"
            " recipe of NeuROS or of the project, and does this machine allow user namespaces"
            " (unshare --user true)?"
        )
