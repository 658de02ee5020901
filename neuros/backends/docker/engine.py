"""The connection to the Docker engine, and its errors in one sentence."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import docker
import requests
from docker import DockerClient
from docker.context import ContextAPI
from docker.errors import APIError, DockerException

from neuros.errors import EnvironmentFault

OLDEST_API, OLDEST_ENGINE = (1, 41), "20.10"

_USUAL_SOCKET = Path("/var/run/docker.sock")
_USUAL_ADDRESS = f"unix://{_USUAL_SOCKET}"
_TIMEOUT_S = 60.0
# Attributes of a node's resources, and how `docker info` calls the ability to keep to them.
_LIMITS = {"mem_bytes": "MemoryLimit", "cpus": "CpuCfsQuota", "pids": "PidsLimit"}
OR_WITHOUT = "or run without containers: --backend process"


def connect(
    environ: Mapping[str, str] = os.environ, *, timeout_s: float | None = _TIMEOUT_S
) -> DockerClient:
    """Connect to the engine that ``DOCKER_HOST``, the current context, or the usual socket names.

    Without the usual socket, that of rootless Docker counts. A single request may last
    ``timeout_s`` seconds, ``None`` for any time; the caller closes the client.

    Raises:
        EnvironmentFault: where there is none, it may not be used, or it is too old.
    """
    given = dict(environ)
    where = given.get("DOCKER_HOST", "")
    try:
        if not where:  # `docker context use` may have chosen one
            address = ContextAPI.kwargs_from_context(environment=given).get("base_url", "")
            where = str(address).removeprefix("http+")
        if where in ("", _USUAL_ADDRESS):
            folder = given.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
            rootless = Path(folder) / "docker.sock"
            is_rootless = rootless.is_socket() and not _USUAL_SOCKET.exists()
            where = given["DOCKER_HOST"] = f"unix://{rootless if is_rootless else _USUAL_SOCKET}"
        scheme, _, path = where.partition("://")
        if scheme == "unix":  # the operating system's own error says more than the SDK's
            with socket.socket(socket.AF_UNIX) as tried:
                tried.connect(path)
        # "auto" asks the engine, so that all other errors appear here.
        engine = docker.from_env(version="auto", timeout=timeout_s, environment=given)
    except (DockerException, requests.RequestException, OSError, ValueError) as error:
        cause = _cause(error)
        if isinstance(cause, PermissionError):
            why = (
                f"this user may not use the Docker engine at {where}: sudo usermod -aG docker"
                f" {os.environ.get('USER', '$USER')}, then log in again (or install rootless"
                " Docker)"
            )
        elif cause is not None:
            why = (
                f"no Docker engine answers at {where} ({cause.strerror or cause}): install and"
                " start it (sudo apt-get install docker.io; sudo systemctl start docker)"
            )
        else:
            why = f"the Docker engine at {where} cannot be used ({error}): see DOCKER_HOST"
        raise EnvironmentFault(f"{why}, {OR_WITHOUT}") from error
    found = tuple(map(int, str(engine.api.api_version).split(".")))
    if found < OLDEST_API:
        engine.close()
        raise EnvironmentFault(
            f"the Docker engine at {where} is too old (API {engine.api.api_version}): install"
            f" Docker {OLDEST_ENGINE} or newer, {OR_WITHOUT}"
        )
    return engine


@dataclass(frozen=True)
class Abilities:
    """Abilities of an engine, and its owner.

    Attributes:
        is_rootless: whether it runs as an ordinary user, who is root in its containers.
        unkept: attributes of :class:`neuros.project.model.Resources` without effect, for lack of
            control groups.
    """

    is_rootless: bool = False
    unkept: frozenset[str] = frozenset()

    @staticmethod
    def of(facts: Mapping[str, Any]) -> Abilities:
        """Read the answer of ``docker info``, or podman's."""
        of_podman = bool(facts.get("Rootless"))
        ignores_all = of_podman and facts.get("CgroupVersion") == "1"
        return Abilities(
            of_podman or "name=rootless" in (facts.get("SecurityOptions") or ()),
            frozenset(k for k, fact in _LIMITS.items() if ignores_all or facts.get(fact) is False),
        )


def require_program() -> None:
    """Check that the program ``docker`` exists; an engine can run without it.

    Raises:
        EnvironmentFault: if it is absent, with the package that has it.
    """
    if shutil.which("docker") is None:
        raise EnvironmentFault(
            "there is no program docker here: sudo apt-get install docker.io (from Debian 13 on:"
            " docker-cli)"
        )


@contextmanager
def engine_faults(doing: str) -> Iterator[None]:
    """Turn errors of the Docker SDK into ``EnvironmentFault``, which begins with ``doing``."""
    try:
        yield
    except APIError as error:
        raise EnvironmentFault(f"{doing}: {explain(str(error.explanation or error))}") from error
    except (DockerException, requests.RequestException) as error:
        if isinstance(_cause(error), ConnectionError | FileNotFoundError):
            raise EnvironmentFault(f"{doing}: the Docker engine has gone away") from error
        raise EnvironmentFault(f"{doing}: {error}") from error


def engine_socket(engine: DockerClient) -> str:
    """The Unix socket of the engine.

    Raises:
        EnvironmentFault: for another kind of address, which may be that of another machine without
            the folders of project and run.
    """
    path = getattr(engine.api.get_adapter(engine.api.base_url), "socket_path", None)
    if path is None:
        raise EnvironmentFault(
            f"the Docker engine at {engine.api.base_url} may be on another machine: set"
            " DOCKER_HOST to the socket of one on this machine (unix:///var/run/docker.sock)"
        )
    return str(path)


def engine_name(version: Mapping[str, Any]) -> str:
    """Docker's version, or podman's with its name, from the answer of ``docker version``."""
    names = [str(each.get("Name")) for each in version.get("Components") or ()]
    prefix = "podman " if any(name.startswith("Podman") for name in names) else ""
    return f"{prefix}{version['Version']}"


def explain(text: str) -> str:
    """The engine's message on one line, with a remedy where one is known."""
    said = " ".join(text.split())
    if "no space left on device" in said.lower():
        return f"{said}: the disk is full: make room (docker system df; docker image prune)"
    if "container-init binary not found" in said:  # podman's, which Debian only recommends
        return f"{said}: sudo apt-get install catatonit"
    if "could not select device driver" in said and "gpu" in said:
        return "the engine cannot give it a GPU: install the NVIDIA Container Toolkit"
    return said


def _cause(error: BaseException) -> OSError | None:
    """The operating system's error inside the errors of three libraries."""
    to_see: list[Any] = [error]
    while to_see:
        each = to_see.pop()
        if not isinstance(each, BaseException):
            continue
        if isinstance(each, OSError) and not isinstance(each, requests.RequestException):
            return each
        to_see += [each.__cause__, each.__context__, getattr(each, "reason", None), *each.args]
    return None
