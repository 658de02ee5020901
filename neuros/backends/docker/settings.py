"""Settings of a container, from its node, its image and the user.

By default a container is locked down: the caller's user id and no capability, no rights from
set-user-id bits, a read-only root file system, a ``/tmp`` of its own. It can read the project and
the workspace. In the run folder it can write new files and its node's folder, and only read the
files of the run and of other nodes. Its paths for these folders are the same on each machine.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.backends.docker.leftovers import RUN_LABEL
from neuros.backends.node_command import (
    DEFAULTS,
    THREAD_VARIABLES,
    log_file,
    moved,
    node_environment,
    node_folder,
    start_arguments,
    thread_limits,
    with_messages,
)
from neuros.backends.run_processes import RUN_ID
from neuros.control import CONTROL_VARIABLE
from neuros.distribution import libraries
from neuros.errors import EnvironmentFault
from neuros.ports import NodeProgram
from neuros.project.model import Folders, Node, NodeFile
from neuros.project.split import translated

if TYPE_CHECKING:
    from neuros.backends.docker.images import Image

ROOT = Path("/neuros")
FOLDERS = Folders(project=ROOT / "project", workspace=ROOT / "workspace", run=ROOT / "run")
"""The folders of a node, as paths in its container."""

MESSAGES = ROOT / "messages"
"""The built message packages of the run, with the folder names of this machine."""

LIBRARY = ROOT / "lib"
"""On ``PYTHONPATH``: NeuROS itself, from the launcher's installation."""

XAUTHORITY = ROOT / "xauthority"
"""The key to the user's display, for nodes with a display."""

DDS_FILE = ROOT / "fast_dds.xml"
"""The user's settings of Fast DDS, if any."""

_INSIDE = re.compile(rf"(?<![\w/.]){ROOT}/({'|'.join(each.name for each in fields(Folders))})\b")

# Discovery stays on this machine, so nodes share its network. Large packets go through shared
# memory, which only the containers of one run share.
NETWORK_MODE = "host"
NO_NETWORK = "none"
IPC_MODE = "private"
SHARED_MEMORY = Path("/dev/shm")

MOST_PIDS = 4096
"""Processes and threads of a node without a limit: it confines a fork bomb to its container."""

PASSED_ON = (
    *("LANG", "LC_ALL", "TZ", *THREAD_VARIABLES),
    *("MUJOCO_GL", "NEUROS_EXECUTOR", "RCUTILS_CONSOLE_OUTPUT_FORMAT", "ROS_STATIC_PEERS"),
)
"""The variables of the launcher's environment that a container gets."""

# Names a file with the user's settings of Fast DDS.
DDS_SETTINGS = "FASTRTPS_DEFAULT_PROFILES_FILE"

X11 = Path("/tmp/.X11-unix")
_TMP = "rw,exec,nosuid,nodev,size=1g,mode=1777"
# `docker logs` shows where the log is: the node writes it itself, so that no output passes through
# the engine, and none is lost when the engine or the launcher dies.
_START = 'echo "the output of this node is in $1"; log=$0; shift; exec "$@" >>"$log" 2>&1'


def container_settings(
    file: NodeFile,
    image: Image,
    program: NodeProgram,
    environment: Mapping[str, str],
    *,
    others: Sequence[Path] = (),
    launcher_pid: int = 0,
    network: str = NETWORK_MODE,
    is_rootless: bool = False,
) -> dict[str, Any]:
    """The arguments of ``docker.containers.create`` for a node.

    Args:
        file: the node with the paths of this machine.
        environment: that the run adds to that of each node.
        others: entries of the run folder that the node can only read.
        launcher_pid: for a label.
        network: that of this machine, none, or that of another container.
        is_rootless: whether the engine is rootless: it names its user root in containers, without
            further rights.

    Raises:
        EnvironmentFault: if a device of the node, or a file with settings of DDS, is not there.
    """
    node, environ, seen = file.node, program.environ, inside(file)
    run_id, cores = environment.get(RUN_ID, ""), program.cores.get(node.name)
    told = {
        **DEFAULTS,
        **{key: environ[key] for key in PASSED_ON if key in environ},
        "HOME": "/tmp",
        "XDG_CACHE_HOME": "/tmp/.cache",  # for libraries that read the user's entry instead
        "USER": "neuros",  # the user id has no name in the image
        **(thread_limits([node]) if cores else {}),
        **node_environment(seen),
        **environment,
        **with_messages({"PYTHONPATH": str(LIBRARY)}, seen.messages),
        "ROS_LOG_DIR": str(FOLDERS.run),
    }
    if address := environment.get(CONTROL_VARIABLE):
        told[CONTROL_VARIABLE] = address.replace(str(file.folders.run), str(FOLDERS.run))
    own = node_folder(file) / "node.json"
    mounts = [
        *(mount(folder, LIBRARY / name) for name, folder in libraries().items()),
        mount(file.folders.project, FOLDERS.project),
        mount(file.folders.run, FOLDERS.run, read_only=False),
        # The node may write to the folder of this file, but not to the file.
        mount(own, node_folder(seen) / own.name),
        *(mount(path, FOLDERS.run / path.relative_to(file.folders.run)) for path in others),
        mount(shared_memory(run_id), SHARED_MEMORY, read_only=False),
    ]
    if file.folders.workspace.is_dir():  # an installed NeuROS comes without one
        mounts.append(mount(file.folders.workspace, FOLDERS.workspace))
    for here, there in zip(file.messages, seen.messages, strict=True):
        mounts.append(mount(here.parent, there.parent))
    if named := environ.get(DDS_SETTINGS):
        path = Path(named).absolute()
        if not path.is_file():
            raise EnvironmentFault(
                f"{DDS_SETTINGS}={named}: there is no such file: unset it, or name one"
            )
        told[DDS_SETTINGS] = str(DDS_FILE)
        mounts.append(mount(path, DDS_FILE))
    if node.access.display and (display := environ.get("DISPLAY")):
        told["DISPLAY"] = display
        if "NEUROS_GUI" in environ:
            told.setdefault("NEUROS_GUI", environ["NEUROS_GUI"])
        if X11.is_dir():  # with a display over the network (ssh -X) there may be none
            mounts.append(mount(X11, X11))
        key = Path(environ.get("XAUTHORITY") or Path(environ.get("HOME", "/")) / ".Xauthority")
        if key.is_file():
            told["XAUTHORITY"] = str(XAUTHORITY)
            mounts.append(mount(key, XAUTHORITY))
    groups = set()
    for device in node.access.devices:
        try:
            groups.add(os.stat(device).st_gid)
        except OSError as error:
            raise EnvironmentFault(
                f"node '{node.name}' asks for the device {device}: {error.strerror}: is it plugged"
                f" in? Another one: --set nodes.{node.name}.devices='[\"/dev/...\"]'"
            ) from error
    groups.intersection_update(() if is_rootless else os.getgroups())
    return {
        "image": image.id,
        "name": container_name(file, run_id),
        "entrypoint": [
            *("/bin/sh", "-c", _START, str(log_file(seen)), str(log_file(file))),
            *start_arguments(program.command(image.start), [seen]),
        ],
        "command": [],
        "environment": told,
        "working_dir": str(FOLDERS.run),
        "labels": {
            RUN_LABEL: run_id,
            "neuros.node": node.name,
            "neuros.project": str(file.folders.project),
            "neuros.run_folder": str(file.folders.run),
            "neuros.launcher": str(launcher_pid),
        },
        "mounts": mounts,
        "user": "0:0" if is_rootless else f"{os.getuid()}:{os.getgid()}",
        "group_add": [str(group) for group in sorted(groups)],
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges"],
        "read_only": True,
        "tmpfs": {"/tmp": _TMP},
        "init": True,
        "network_mode": network,
        "ipc_mode": IPC_MODE,
        "auto_remove": True,
        **limits(node),
        **({"cpuset_cpus": ",".join(map(str, cores))} if cores else {}),
    }


def limits(node: Node) -> dict[str, Any]:
    """Arguments of ``docker.containers.create`` for the limits and devices of a node."""
    resources = node.resources
    settings: dict[str, Any] = {"pids_limit": resources.pids or MOST_PIDS}
    if resources.mem_bytes is not None:
        # Without swap: a node that pages is as bad as one that has ended, and harder to notice.
        settings |= {"mem_limit": resources.mem_bytes, "memswap_limit": resources.mem_bytes}
    if resources.cpus is not None:
        settings["nano_cpus"] = int(resources.cpus * 1e9)
    if node.access.devices:
        settings["devices"] = [f"{device}:{device}:rw" for device in node.access.devices]
    if node.access.gpus:
        are_all = tuple(node.access.gpus) == ("all",)
        chosen = {"count": -1} if are_all else {"device_ids": list(node.access.gpus)}
        settings["device_requests"] = [{**chosen, "capabilities": [["gpu"]]}]
    return settings


def container_name(file: NodeFile, run_id: str) -> str:
    return f"neuros-{file.node.name}-{run_id[:8]}"


def shared_memory(run_id: str) -> Path:
    """The folder of this machine that the containers of a run have as their ``/dev/shm``."""
    return SHARED_MEMORY / f"neuros_{run_id}"


def mount(here: Path, there: Path, *, read_only: bool = True) -> dict[str, Any]:
    """The mount of a folder or file of this machine in a container."""
    return {"Type": "bind", "Source": str(here), "Target": str(there), "ReadOnly": read_only}


def inside(file: NodeFile) -> NodeFile:
    """A node with the paths of its container; paths without a mount stay."""
    here = file.folders
    places = [(getattr(here, each.name), getattr(FOLDERS, each.name)) for each in fields(Folders)]
    places += [(python.parent, MESSAGES / python.parent.name) for python in file.messages]
    return replace(
        file,
        node=translated(file.node, lambda path: moved(path, places)),
        folders=FOLDERS,
        messages=tuple(moved(path, places) for path in file.messages),
    )


def outside(file: NodeFile, folders: Folders, messages: Path = MESSAGES) -> NodeFile:
    """The inverse of :func:`inside`: a node with the paths of a machine with these folders.

    Args:
        messages: the folder with built message packages.
    """
    there = [(getattr(FOLDERS, e.name), getattr(folders, e.name)) for e in fields(Folders)]
    pairs = [*there, (MESSAGES, messages)]
    return replace(
        file,
        node=translated(file.node, lambda path: moved(path, pairs)),
        folders=folders,
        messages=tuple(moved(path, pairs) for path in file.messages),
    )


def as_here(text: str, folders: Folders) -> str:
    """Text of a node, with its paths replaced by those of this machine."""
    here = {each.name: str(getattr(folders, each.name)) for each in fields(Folders)}
    return _INSIDE.sub(lambda match: here[match[1]], text)
