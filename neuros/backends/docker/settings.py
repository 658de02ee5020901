"""Settings of a container, from its node, its image and the user.

By default a container is locked down: the caller's user id and no capability, nothing gained by
programs with the set-user-id bit, a root file system that cannot be written to, a ``/tmp`` that
goes with it. It sees the project and the workspace, which it can read, and the run folder, where it
can write new files and into a folder of its own: what the other nodes and the run itself have there
it can only read. The paths under which it sees them do not depend on the machine.
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
"""What a node may read and write, as it sees it."""

MESSAGES = ROOT / "messages"
"""The built message packages of the run, each in a folder that has the same name here."""

LIBRARY = ROOT / "lib"
"""What ``PYTHONPATH`` names: NeuROS itself is in there, from the launcher's own installation."""

XAUTHORITY = ROOT / "xauthority"
"""The key to the user's display, where a node has one."""

DDS_FILE = ROOT / "fast_dds.xml"
"""The user's own settings of Fast DDS, where there are any."""

_INSIDE = re.compile(rf"(?<![\w/.]){ROOT}/({'|'.join(each.name for each in fields(Folders))})\b")

# Discovery stays on this machine, so that nodes have to share its network. Large packets go through
# shared memory where both ends see the same: the containers of one run do, and see nobody else's.
NETWORK_MODE = "host"
NO_NETWORK = "none"
IPC_MODE = "private"
SHARED_MEMORY = Path("/dev/shm")

MOST_PIDS = 4096
"""Processes and threads of a node that sets no limit: what keeps a fork bomb to its container."""

PASSED_ON = (
    *("LANG", "LC_ALL", "TZ", *THREAD_VARIABLES),
    *("MUJOCO_GL", "NEUROS_EXECUTOR", "RCUTILS_CONSOLE_OUTPUT_FORMAT", "ROS_STATIC_PEERS"),
)
"""What a container gets of the launcher's environment; the rest of it stays outside."""

# Fast DDS reads settings of the user's own from the file that this names.
DDS_SETTINGS = "FASTRTPS_DEFAULT_PROFILES_FILE"

X11 = Path("/tmp/.X11-unix")
_TMP = "rw,exec,nosuid,nodev,size=1g,mode=1777"
# What the engine keeps (`docker logs`) says where the rest is: the node writes its log itself, so
# that nothing passes through the engine, and nothing is lost when that or the launcher dies.
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
        environment: what the run adds to that of each node.
        others: what is in the run folder and not the node's own; it can only read that.
        launcher_pid: said in a label.
        network: that of this machine, none, or that of another container.
        is_rootless: whether the engine is, which calls its user root in containers, with no more
            rights.

    Raises:
        EnvironmentFault: if a device of the node, or a file with settings of DDS, is not there.
    """
    node, environ, seen = file.node, program.environ, inside(file)
    run_id, cores = environment.get(RUN_ID, ""), program.cores.get(node.name)
    told = {
        **DEFAULTS,
        **{key: environ[key] for key in PASSED_ON if key in environ},
        "HOME": "/tmp",
        "XDG_CACHE_HOME": "/tmp/.cache",  # for libraries that go by the user's entry instead
        "USER": "neuros",  # for programs that ask who they are: the id has no name in the image
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
        # In a folder that it may write to; but what it was told stays as it was.
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
    """Arguments of ``docker.containers.create``: what a node may take, and its devices."""
    resources = node.resources
    settings: dict[str, Any] = {"pids_limit": resources.pids or MOST_PIDS}
    if resources.mem_bytes is not None:
        # Without swap: a node that pages is no better than one that has ended, and does not say so.
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
    """The name of a container: unique, and to be recognised in ``docker ps``."""
    return f"neuros-{file.node.name}-{run_id[:8]}"


def shared_memory(run_id: str) -> Path:
    """The folder of this machine that the containers of a run have as their ``/dev/shm``."""
    return SHARED_MEMORY / f"neuros_{run_id}"


def mount(here: Path, there: Path, *, read_only: bool = True) -> dict[str, Any]:
    """A folder or file of this machine, as a container sees it."""
    return {"Type": "bind", "Source": str(here), "Target": str(there), "ReadOnly": read_only}


def inside(file: NodeFile) -> NodeFile:
    """A node with all paths as it sees them in its container; what it does not see stays."""
    here = file.folders
    places = [(here.project, FOLDERS.project), (here.workspace, FOLDERS.workspace)]
    places += [(python.parent, MESSAGES / python.parent.name) for python in file.messages]
    return replace(
        file,
        node=translated(file.node, lambda path: moved(path, places)),
        folders=FOLDERS,
        messages=tuple(moved(path, places) for path in file.messages),
    )


def outside(file: NodeFile, folders: Folders, messages: Path = MESSAGES) -> NodeFile:
    """The inverse of :func:`inside`: the node with the paths of a machine with these folders.

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
