"""Deployment files: which machine each node of a project runs on.

A deployment is not part of the project: an experiment does not depend on where it runs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from neuros.errors import Problem, ProjectError
from neuros.project.model import Project
from neuros.project.scanner import Element, SourceError, read_file
from neuros.project.suggest import did_you_mean
from neuros.project.validate import violations_in

HERE = "here"
"""The machine of the launcher, which needs no entry."""
TIMEOUT_S = 5.0
_WAYS = ("ssh", "docker", "through")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


@dataclass(frozen=True)
class Host:
    """A machine, and the way to reach it.

    Attributes:
        ssh: its destination for ``ssh``, as ``pi@robot``.
        docker: the address of its Docker engine, as in ``DOCKER_HOST``, instead of ``ssh``: nodes
            run in containers there.
        ssh_options: further arguments of ``ssh``.
        through: a command that executes its arguments there, instead of ``ssh``.
        neuros: the command ``neuros`` there.
        address: its address for other machines; empty: the one that ``ssh`` has used.
    """

    name: str
    ssh: str = ""
    docker: str = ""
    ssh_options: tuple[str, ...] = ()
    through: tuple[str, ...] = ()
    neuros: str = "neuros"
    address: str = ""

    @property
    def way(self) -> str:
        """The way to reach it, in a word or a line."""
        return self.ssh or self.docker or " ".join(self.through)

    def __str__(self) -> str:
        return self.name if self.through else f"{self.name} ({self.way})"


@dataclass(frozen=True)
class DeploymentFile:
    """A checked deployment.

    Attributes:
        hosts: the machines besides this one, by name.
        places: the name of each node's host; nodes without one run here.
        here: the entry of this machine.
        timeout_s: a machine that is silent for longer counts as gone.
    """

    file: Path
    hosts: Mapping[str, Host]
    places: Mapping[str, str]
    here: Host = field(default_factory=lambda: Host(HERE))
    timeout_s: float = TIMEOUT_S

    @property
    def used(self) -> list[Host]:
        """The machines besides this one on which nodes run."""
        return [host for name, host in self.hosts.items() if name in self.places.values()]


def load_deployment(path: Path, project: Project | None = None) -> DeploymentFile:
    """Read a deployment file, and check it against a project.

    Raises:
        ProjectError: with all its problems.
    """
    try:
        root, problems = read_file(path.absolute())
    except SourceError as error:
        raise ProjectError([error.problem]) from None
    problems += violations_in(root, "deployment")
    problems += _mistakes(root, project, [problem.pointer for problem in problems])
    if problems:
        raise ProjectError(problems)
    hosts = {name: _host(name, each) for name, each in (root.plain.get("hosts") or {}).items()}
    places = {node: host for node, host in root.plain.get("nodes", {}).items() if host != HERE}
    timeout_s = float(root.plain.get("timeout_s", TIMEOUT_S))
    here = hosts.pop(HERE, Host(HERE))
    return DeploymentFile(path.absolute(), hosts, places, here, timeout_s)


def _host(name: str, keys: Mapping[str, object]) -> Host:
    lists = {key: tuple(each) for key, each in keys.items() if isinstance(each, list)}
    return Host(name, **{**keys, **lists})  # type: ignore[arg-type]


def _mistakes(root: Element, project: Project | None, wrong: Sequence[str]) -> list[Problem]:
    """Mistakes that the schema cannot express; ``wrong``: pointers to those that it has found."""
    found: list[Problem] = []
    known = {HERE}
    for name, host in root.members("hosts").items():
        known.add(name)
        if any(f"{each}/".startswith(f"{host.pointer}/") for each in wrong):
            continue
        found += _control_characters(host)
        ways = [key for key in _WAYS if key in host.value]
        if name == HERE and ways:
            text = f"'{HERE}' is the launching machine, which needs no '{ways[0]}'"
            hint = "give the other machine another name"
            found.append(host.value[ways[0]].key_problem(text, hint))
        elif name != HERE and len(ways) != 1:
            text = "needs exactly one of 'ssh', 'docker' and 'through', which say how to reach it"
            found.append(host.problem(text, f"this machine is '{HERE}'"))
        elif (ssh := host.value.get("ssh")) is not None and ssh.value.startswith("-"):
            found.append(ssh.problem("is an option, not a destination: user@host"))
        elif host.value.get("docker") is not None and "neuros" in host.value:
            text = "has no effect with 'docker': NeuROS comes into the containers by itself"
            found.append(host.value["neuros"].key_problem(text, "leave it out"))
        if (docker := host.value.get("docker")) is not None and (why := _unusable(docker.value)):
            hint = "ssh://USER@HOST, tcp://HOST:PORT or unix:///PATH"
            found.append(docker.problem(f"is no address of a Docker engine: {why}", hint))
    names = None if project is None else [node.name for node in project.nodes]
    for node, host in root.members("nodes").items():
        if isinstance(host.value, str) and host.value not in known:
            hint = did_you_mean(host.value, known) or f"there are {', '.join(sorted(known))}"
            found.append(host.problem(f"there is no host '{host.value}'", hint))
        if names is not None and node not in names:
            text, hint = f"the project has no node '{node}'", did_you_mean(node, names)
            found.append(host.key_problem(text, hint))
    return found


def _control_characters(host: Element) -> Iterator[Problem]:
    """Problems of control characters, which commands refuse or users cannot see."""
    for key in host.value.values():
        for each in key.value if isinstance(key.value, list) else [key]:
            if strange := _CONTROL.search(each.value):
                text = f"has the control character \\u{ord(strange[0]):04x}"
                yield each.problem(text, "remove it")


def _unusable(address: str) -> str:
    """Why an address cannot be that of a Docker engine; empty if it can."""
    try:
        where = urlsplit(address)
        port = where.port
    except ValueError as error:
        return str(error)
    return "the port is missing" if where.scheme == "tcp" and port is None else ""
