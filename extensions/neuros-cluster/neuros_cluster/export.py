"""Files with which Docker Compose or Kubernetes start the nodes of a project.

For Slurm it is a batch script (:func:`neuros_cluster.slurm.slurm_script`).

The written folder holds all that a run needs, except the images of the nodes' containers::

    compose.yaml or kubernetes.yaml
    nodes.json         the node.json of every node: the configuration
    Dockerfile         adds the folder image/ to the image of a container
    image/             NeuROS, the project, its messages: /neuros in a container
    runs/              the run folders, with Compose

Containers start :mod:`neuros_cluster.part`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from neuros.api.plan import named_peers, time_problems
from neuros.api.request import parse_duration
from neuros.backends.containers import bare_name, files_of, find_recipe
from neuros.backends.domain import valid_domain
from neuros.backends.node_command import THREAD_VARIABLES
from neuros.distribution import WORKSPACE, libraries, python_command
from neuros.errors import ProjectError, UsageError
from neuros.options import options_of
from neuros.ports import JobResources
from neuros.project.files_to_copy import files_to_copy
from neuros.project.load import PROJECT_FILE
from neuros.project.model import Folders, Node, NodeFile, Project, memory_text
from neuros.project.paths import NOT_COPIED
from neuros.project.split import split, translated
from neuros.project.suggest import did_you_mean
from neuros_cluster.command import ExportOptions, check_names
from neuros_cluster.part import parts_to_json
from neuros_cluster.slurm import filled, slurm_script

ROOT = Path("/neuros")
FOLDERS = Folders(project=ROOT / "project", workspace=ROOT / "lib/workspace", run=ROOT / "runs")
"""The folders of a node in its container; NeuROS finds its workspace beside itself."""

NODES_FILE = "nodes.json"
_LIBRARY, _MESSAGES = ROOT / "lib", ROOT / "messages"
_RUN = "${RUN:-run}"
_MOST_PIDS = 4096
_OF_CONTAINERS = ("peers", "peer_timeout", "host_network", "registry", "volume_claim")
_OF_SLURM = ("place", "spread")
_STOP_S = 15  # besides the time of finalise hooks: peers exchange their counts
_LONGEST_LABEL = 63  # of DNS
_MOST_MACHINES = 65_536  # no cluster has more
# A dependency of a node's launcher that images of nodes lack: pure Python, in one folder.
_VENDORED = "tabulate"


@dataclass(frozen=True)
class Part:
    """A node and its container.

    Attributes:
        name: of the service: the node's name in the form of DNS.
        base: the image of the node's container.
        image: the image that is built on it.
        command: the arguments of ``neuros part`` after ``nodes.json``.
        run: its run folder.
    """

    node: Node
    name: str
    base: str
    image: str
    command: Sequence[str]
    run: str


class Export:
    """The files of a project, and their writing into a folder.

    Args:
        messages: folders on Python's path of the built message packages that the project needs.
    """

    def __init__(self, project: Project, messages: Sequence[Path], options: ExportOptions) -> None:
        self.project = project
        self.options = options
        self._messages = messages
        self.folder = Path(options.output or f"{slug(project.name)}-{options.form}").absolute()

    @cached_property
    def name(self) -> str:
        """The name of the project in the form of DNS and image names."""
        return slug(self.project.name)

    @cached_property
    def names(self) -> Mapping[str, str]:
        """The name of each node's service."""
        found: dict[str, str] = {}
        for index, node in enumerate(self.project.nodes):
            name = slug(node.name)
            found[node.name] = f"{name}-{index}" if name in found.values() else name
        return found

    @cached_property
    def files(self) -> list[NodeFile]:
        """The ``node.json`` of every node, with the paths of its container."""
        folders = [(self.project.folder, FOLDERS.project), (WORKSPACE, FOLDERS.workspace)]

        def inside(path: Path) -> Path:
            for here, there in sorted(folders, key=lambda pair: -len(pair[0].parts)):
                if path.is_relative_to(here):
                    return there / path.relative_to(here)
            return path

        files = split(self.project, lambda _: FOLDERS)
        return [replace(file, node=translated(file.node, inside)) for file in files]

    def parts(self, host_of: Callable[[str], str], run: str = _RUN) -> list[Part]:
        """The part of each node; ``host_of`` returns the host name of a service."""
        return [self._part(node, host_of, run) for node in self.project.nodes]

    def _part(self, node: Node, host_of: Callable[[str], str], run: str) -> Part:
        options, name = self.options, self.names[node.name]
        folder = f"{FOLDERS.run}/{run}/{node.name}"
        others = [host_of(each) for key, each in self.names.items() if key != node.name]
        peers = options.peers or ("" if options.host_network else ",".join(others))
        command = [node.name, "-d", str(options.domain_id or 0), "-o", folder]
        command += ["--peer-timeout", str(options.peer_timeout)]
        command += ["--peers", peers] if peers else []
        duration = str(options.duration or "")
        if duration and (node.owns_time or not duration.endswith("sim")):
            command += ["--duration", duration]
        recipe = find_recipe(node.container, self.project.folder)
        base = recipe.tags[-1] if recipe else node.container
        registry = f"{options.registry.rstrip('/')}/" if options.registry else ""
        image = f"{registry}{self.name}-{slug(bare_name(node.container))}:{self._tag}"
        return Part(node, name, base, image, command, folder)

    @cached_property
    def _tag(self) -> str:
        """A digest of the content of images."""
        whole = hashlib.sha256(self._dockerfile.encode())
        for file in files_of(self.folder / "image"):
            whole.update(str(file.relative_to(self.folder)).encode())
            whole.update(file.read_bytes())
        return whole.hexdigest()[:12]

    @property
    def _dockerfile(self) -> str:
        messages = [str(_MESSAGES / python.parent.name / "python") for python in self._messages]
        threads = " ".join(f"{variable}=1" for variable in THREAD_VARIABLES)
        path = os.pathsep.join([*messages, str(_LIBRARY)])
        start = python_command("neuros.cli", "part", str(ROOT / NODES_FILE), python="python3")
        entrypoint = json.dumps(start)
        return filled("Dockerfile", path=path, threads=threads, entrypoint=entrypoint)

    def write(self) -> Path:
        """Write the folder; returns the file for the engine.

        Raises:
            ProjectError: the project has links or files that may not go into an image.
            UsageError: the folder exists or cannot be written, or the engine lacks something that a
                node needs.
        """
        form = FORMS[self.options.form]
        if self.options.host_network and form.file == "kubernetes.yaml":
            raise UsageError("--host-network: Kubernetes gives each pod an address of its own")
        if form.file == "kubernetes.yaml":
            self._check_names()
        for node in self.project.nodes:
            for what in form.lacks:
                if getattr(node.access, what):
                    raise UsageError(
                        f"node '{node.name}' asks for {what}, and {self.options.form} has none for"
                        " its containers: export for compose, or run that node with"
                        " `neuros launch -n`"
                    )
        found, problems = files_to_copy(self.project.folder, self.folder)
        if problems:
            raise _NotExported(problems)
        with _new(self.folder):
            for each in ("runs", "image/runs"):
                (self.folder / each).mkdir(parents=True)
            # Volumes begin as a copy of the image's folder, and any user must be able to write.
            (self.folder / "image/runs").chmod(0o1777)
            self._copy(found)
            (self.folder / "Dockerfile").write_text(self._dockerfile, "utf-8")
            (self.folder / ".dockerignore").write_text("runs\n", "utf-8")
            content = json.dumps(parts_to_json(self.project, self.files), indent=2) + "\n"
            (self.folder / NODES_FILE).write_text(content, "utf-8")
            file = self.folder / form.file
            documents = form.documents(self)
            text = yaml.dump_all(documents, Dumper=_Dumper, sort_keys=False, width=10_000)
            file.write_text(form.head + text, "utf-8")
        return file

    def _check_names(self) -> None:
        """Check DNS labels: RFC 1035 for a Service, RFC 1123 for the host of an indexed Job."""
        hosts = {f"node '{node}'": f"{self.name}-{name}-0" for node, name in self.names.items()}
        wrong = {what: host for what, host in hosts.items() if len(host) > _LONGEST_LABEL}
        if not self.name[0].isalpha() or len(self.name) > _LONGEST_LABEL:
            wrong = {f"project '{self.project.name}'": self.name, **wrong}
        if wrong:
            raise UsageError(
                "\n".join(
                    f"{what} would be '{name}' for Kubernetes, whose names begin with a letter and"
                    f" have at most {_LONGEST_LABEL} characters: rename the folder of the project,"
                    " or the node"
                    for what, name in wrong.items()
                )
            )

    def _copy(self, found: Collection[Path]) -> None:
        """Fill the image; ``found``: the only files of the project that go into it."""
        image = self.folder / "image"

        def left_out(folder: str, names: list[str]) -> Iterable[str]:
            return [name for name in names if Path(folder, name) not in found]

        try:
            shutil.copytree(self.project.folder, image / "project", ignore=left_out)
        except shutil.Error as error:
            why = "\n".join(f"{path} cannot be copied: {text}" for path, _, text in error.args[0])
            raise UsageError(why) from error
        for name, folder in libraries().items():
            shutil.copytree(folder, image / "lib" / name, ignore=NOT_COPIED)
        if WORKSPACE.is_dir():
            shutil.copytree(WORKSPACE, image / "lib/workspace", ignore=NOT_COPIED)
        spec = find_spec(_VENDORED)
        for place in (spec.submodule_search_locations or ()) if spec else ():
            shutil.copytree(place, image / "lib" / _VENDORED, ignore=NOT_COPIED)
        for python in self._messages:
            folder = image / "messages" / python.parent.name
            shutil.copytree(python.parent, folder, ignore=NOT_COPIED)


class _NotExported(ProjectError):
    outcome = "nothing was written"


def slug(name: str) -> str:
    """A name in the form of DNS and image names: lower case, digits, and - between them."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "project"


def export(project: Project, messages: Sequence[Path], options: ExportOptions) -> Path:
    """Write a project for an engine; returns the file for the engine.

    Raises:
        ProjectError, UsageError: as :meth:`Export.write` does.
    """
    without = {"slurm": _OF_CONTAINERS}.get(options.form, _OF_SLURM)
    for each in options_of(ExportOptions):
        if each.name in without and getattr(options, each.name) != each.default:
            raise UsageError(f"{each.flags[-1]} is not for {options.form}")
    # Check options that the launchers of nodes, or their engine, would refuse later.
    if problems := time_problems(project, project.nodes, parse_duration(options.duration)):
        raise _NotExported(problems)
    if options.domain_id is not None:
        valid_domain(str(options.domain_id), "-d/--domain-id")
    if options.peers is not None:
        named_peers(options.peers)
    check_names(options)
    if options.form != "slurm":
        return Export(project, messages, options).write()
    script = _slurm_script_of(project, options)
    folder = Path(options.output or f"{slug(project.name)}-slurm").absolute()
    with _new(folder):
        (folder / "job.sh").write_text(script, "utf-8")
    return folder / "job.sh"


@contextlib.contextmanager
def _new(folder: Path) -> Iterator[None]:
    """Make a folder, to be filled inside; undone if that fails. Raises ``UsageError``."""
    try:
        was_there = folder.exists()
        if was_there and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"-o {folder}: is not an empty folder; name a new one")
        folder.mkdir(parents=True, exist_ok=True)
        try:
            yield
        except BaseException:
            for path in (*folder.iterdir(),) if was_there else (folder,):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            raise
    except OSError as error:
        raise UsageError(
            f"{folder} cannot be written ({error.strerror}): name another folder with -o"
        ) from error


# ------------------------------------------------------------------------------- the formats


def _compose(export: Export) -> list[dict[str, Any]]:
    return [{"services": {p.name: _compose_service(export, p) for p in export.parts(str)}}]


def _document(template: str, **values: object) -> Any:
    return yaml.safe_load(filled(template, **{k: json.dumps(v) for k, v in values.items()}))


def _compose_service(export: Export, part: Part) -> dict[str, Any]:
    resources, access = part.node.resources, part.node.access
    service: dict[str, Any] = _document(
        "compose.yaml",
        image=part.image,
        base=part.base,
        command=list(part.command),
        stop=f"{_stop_s(part)}s",
        probe=["CMD", *_is_up(part, "$$")],
        user=f"${{RUN_AS:-{os.getuid()}:{os.getgid()}}}",
        pids=resources.pids or _MOST_PIDS,
    )
    if resources.mem_bytes is not None:
        memory = memory_text(resources.mem_bytes)
        service |= {"mem_limit": memory, "memswap_limit": memory}
    if resources.cpus is not None:
        service["cpus"] = resources.cpus
    if access.devices:
        service["devices"] = [f"{device}:{device}" for device in access.devices]
    if access.gpus:
        wanted = {"count": "all"} if access.gpus == ("all",) else {"device_ids": [*access.gpus]}
        gpu = {"driver": "nvidia", "capabilities": ["gpu"], **wanted}
        service["deploy"] = {"resources": {"reservations": {"devices": [gpu]}}}
    if export.options.host_network:
        service["network_mode"] = "host"
    return service


def _stop_s(part: Part) -> int:
    """Seconds that a container may take to end; orchestrators know no progress."""
    return _STOP_S + math.ceil(part.node.finalise_s)


def _is_up(part: Part, dollar: str = "$") -> list[str]:
    """A probe: succeeds while the launcher of a node listens, and before its run folder exists.

    The run folder is an argument of the shell, since RUN, a part of it, may be any text.
    ``dollar`` is the engine's way of writing a dollar sign.
    """
    run = f'"{dollar}1"'
    return ["sh", "-c", f"test ! -e {run} || test -S {run}/control.sock", "sh", part.run]


def _kubernetes(export: Export) -> list[dict[str, Any]]:
    app = {"app.kubernetes.io/name": "neuros", "app.kubernetes.io/instance": export.name}
    content = json.dumps(parts_to_json(export.project, export.files), indent=2) + "\n"
    hosts = {name: f"{export.name}-{name}-0.{export.name}" for name in export.names.values()}
    return [
        *_document("kubernetes.yaml", name=export.name, app=app, nodes=content),
        *(_job(export, part, app) for part in export.parts(hosts.__getitem__, run="run")),
    ]


def _job(export: Export, part: Part, app: Mapping[str, str]) -> dict[str, Any]:
    labels = {**app, "app.kubernetes.io/component": part.name}
    resources, gpus = part.node.resources, part.node.access.gpus
    limits: dict[str, Any] = {}
    if resources.cpus is not None:
        limits["cpu"] = f"{resources.cpus:g}"
    if resources.mem_bytes is not None:
        limits["memory"] = f"{resources.mem_bytes}"
    if gpus:
        limits["nvidia.com/gpu"] = "1" if gpus == ("all",) else str(len(gpus))
    claim = export.options.volume_claim
    runs = {"persistentVolumeClaim": {"claimName": claim}} if claim else {"emptyDir": {}}
    found: dict[str, Any] = _document(
        "kubernetes_job.yaml",
        job=f"{export.name}-{part.name}",
        labels=labels,
        name=export.name,
        stop=_stop_s(part),
        image=part.image,
        command=list(part.command),
        resources={"limits": limits} if limits else {},
        probe=_is_up(part),
        runs={"name": "runs", **runs},
    )
    return found


@dataclass(frozen=True)
class Form:
    """A format.

    Attributes:
        documents: makes its YAML documents.
        head: comment at the top of the file.
        lacks: keys of ``Access`` that its containers cannot have.
    """

    file: str
    documents: Callable[[Export], list[dict[str, Any]]]
    head: str
    lacks: tuple[str, ...]


FORMS: Mapping[str, Form] = {
    "compose": Form(
        "compose.yaml",
        _compose,
        "# RUN=trial docker compose up --build; the run folders of its nodes are in runs/trial.\n",
        ("display",),
    ),
    "kubernetes": Form(
        "kubernetes.yaml",
        _kubernetes,
        "# Build and push the images of the Dockerfile (extensions/neuros-cluster/README.md), then:"
        " kubectl apply -f kubernetes.yaml\n",
        ("devices", "display"),
    ),
}


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # it has no types
    """Writes texts of several lines as blocks, and no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar(
        "tag:yaml.org,2002:str", text, "|" if "\n" in text else None
    ),
)


def _slurm_script_of(project: Project, options: ExportOptions) -> str:
    """The script for a checked project, with the resources that its nodes declare.

    Raises:
        UsageError: a node is placed that the project lacks, or on an impossible number.
    """
    names = [node.name for node in project.nodes]
    places = {name: number for number, name in enumerate(names)} if options.spread else {}
    for name, number in options.place:
        if name not in names:
            hint = did_you_mean(name, names) or f"it has {', '.join(names)}"
            raise UsageError(f"--place {name}={number}: the project has no such node; {hint}")
        if not 0 <= number < _MOST_MACHINES:
            raise UsageError(
                f"--place {name}={number}: is no node of an allocation: give a number from 0 to"
                f" {_MOST_MACHINES - 1:,}"
            )
        places[name] = number
    on_each = [
        tuple(node for node in project.nodes if places.get(node.name, 0) == number)
        for number in {0, *places.values()}
    ]
    beside = Path(sys.executable).with_name("neuros")
    changes = options.set or ()
    if isinstance(changes, Mapping):
        changes = [f"{path}={json.dumps(value)}" for path, value in changes.items()]
    given: list[tuple[str, object]] = [("-d", options.domain_id), ("--duration", options.duration)]
    given += [("--namespace", options.namespace), *(("--set", each) for each in changes)]
    given += [("--remap", each) for each in options.remap or ()]
    return slurm_script(
        project.file if project.file.name != PROJECT_FILE else project.folder,
        places,
        neuros=str(beside) if beside.exists() else "neuros",
        options=[part for flag, value in given if value is not None for part in (flag, str(value))],
        resources=JobResources.most(
            JobResources.of(replace(project, nodes=nodes)) for nodes in on_each
        ),
    )
