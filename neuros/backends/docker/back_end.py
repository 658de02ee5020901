"""The back end ``docker``: one container per node."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from neuros.backends.containers import STANDARD, find_container
from neuros.backends.docker.settings import outside
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault
from neuros.ports import BackEnd, Deployment, Finding
from neuros.project.model import Folders, Node, NodeFile, Project

# The end of the engine's faults; the report of `auto` leaves it out.
_WITHOUT = ", or run without containers: --backend process"


class Docker(BackEnd):
    """Takes part in ``auto`` before processes: where an engine answers and has the images."""

    name = "docker"
    place = "a container"
    rank = 100
    has_own_pythons = True
    has_own_network = True

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        if find_spec("docker") is None:
            raise EnvironmentFault(
                f"the Python package docker is not installed: {install_command()}"
            )
        check_modules(nodes, project.folder)
        # The Docker SDK is slow to import.
        from neuros.backends.docker.launcher import Containers

        return Containers(nodes, project.folder)

    def why_not(self, fault: EnvironmentFault) -> str:
        reason, *others = super().why_not(fault).split(" (and ")
        return " (and ".join([reason.removesuffix(_WITHOUT), *others])

    def checks(self, environ: Mapping[str, str]) -> Iterable[Finding]:
        return check_containers(STANDARD, environ)

    def on_this_machine(self, file: NodeFile, folders: Folders, messages: Path) -> NodeFile:
        return outside(file, folders, messages)

    def place_in(self, record: Mapping[str, Any], node: str) -> str:
        nodes = record["expanded_project"]["nodes"]
        (container,) = (each["container"] for each in nodes if each["name"] == node)
        engine = record["docker"]  # None if the engine had gone away
        return f"image {engine['images'][container]['name'] if engine else container}"

    def provenance(self, record: Mapping[str, Any]) -> Mapping[str, str]:
        images = ((record.get("docker") or {}).get("images") or {}).values()
        return {"images": ", ".join(image["name"] for image in images)}


BACK_END = Docker()


def check_modules(nodes: Sequence[Node], project: Path) -> None:
    """Check that the container of each node can have the module of its plugin.

    Raises:
        EnvironmentFault: with the necessary lines.
    """
    for node in nodes:
        container = find_container(node.container, project)
        package = node.module.partition(".")[0]
        if package not in ("", "neuros") and container and container.is_own:
            raise EnvironmentFault(
                f"the plugin of node '{node.name}' is {node.module}, and the container"
                f" {node.container} has no package {package}: name it in"
                f" containers/{package}/requirements.txt beside the project file, and write"
                f' "container": "{package}" in the node{_WITHOUT}'
            )


def check_containers(names: Sequence[str], environ: Mapping[str, str]) -> Iterator[Finding]:
    """The engine and, if it answers, the images of NeuROS's own containers."""
    if find_spec("docker") is None:
        yield Finding.absent("Docker", "its Python package is not installed", install_command())
        return
    from neuros.backends.docker.engine import connect, engine_faults, engine_name
    from neuros.backends.docker.images import image_for

    try:
        engine = connect(environ)
    except EnvironmentFault as fault:
        yield Finding.absent("Docker", str(fault))
        return
    with closing(engine):
        try:
            with engine_faults("the engine"):
                version = engine.version()
        except EnvironmentFault as fault:
            yield Finding.bad("Docker", str(fault))
            return
        text = f"engine {engine_name(version)}, API {version['ApiVersion']}"
        yield Finding.good("Docker", text)
        for name in names:
            try:
                image = image_for(name, None, engine)
            except EnvironmentFault as fault:
                yield Finding.absent("image", str(fault))
                continue
            python = "{}.{}".format(*image.python_version)
            if image.notice:
                yield Finding.absent("image", image.notice)
            else:
                yield Finding.good("image", f"{image.name}, Python {python}")
