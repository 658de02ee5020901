"""Provenance of a run: versions, machine, seeds, command line, and the state of the project."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from neuros.arithmetic import ARITHMETIC, processor
from neuros.distribution import __version__
from neuros.project.model import Node
from neuros.project.scanner import read_bytes
from neuros.project.timing import seeds

_GIT_PATIENCE_S = 5.0
_VERSIONS = "versions.json"


def provenance(command: Sequence[str], nodes: Iterable[Node], run_folder: Path) -> dict[str, Any]:
    """Provenance without the state of git, ready for JSON.

    Args:
        command: the command line.
        nodes: all nodes of the project.
        run_folder: has the versions of each node (:func:`note_versions`), and what its arithmetic
            depends on (:func:`~neuros.arithmetic.note_arithmetic`).
    """
    nodes = list(nodes)
    own = python_versions()
    return {
        "command": list(command),
        "versions": {
            "neuros": __version__,
            "kernel": f"{platform.system()} {platform.release()}",
            **own,
            "nodes": {
                node.name: noted
                for node in nodes
                if (noted := _noted(run_folder / node.name / _VERSIONS)) not in (None, own)
            },
        },
        "arithmetic": {
            node.name: noted
            for node in nodes
            if (noted := _noted(run_folder / node.name / ARITHMETIC)) is not None
        },
        "machine": machine(),
        "seeds": seeds(nodes),
    }


def python_versions() -> dict[str, Any]:
    return {
        "python": platform.python_version(),
        "executable": sys.executable,
        "packages": installed_packages(sys.path),
    }


def note_versions(node_folder: Path) -> None:
    """Write the versions of a node's Python into its folder: a container has its own Python."""
    with contextlib.suppress(OSError):  # a full disk is reported by what loses more by it
        (node_folder / _VERSIONS).write_text(json.dumps(python_versions(), indent=2), "utf-8")


def _noted(file: Path) -> Any:
    try:
        return json.loads(read_bytes(file))
    except (OSError, ValueError, RecursionError):  # the node never began, or the disk was full
        return None


def installed_packages(folders: Iterable[str]) -> dict[str, str]:
    """Name and version of every package on a search path."""
    # From names of folders: importlib.metadata would open each of some 200 files (0.2 s).
    found: dict[str, str] = {}
    for folder in folders:
        with contextlib.suppress(OSError):
            for entry in os.listdir(folder or "."):
                name, dash, version = entry.removesuffix(".dist-info").partition("-")
                if dash and entry.endswith(".dist-info"):
                    found.setdefault(name, version)
    return dict(sorted(found.items(), key=lambda pair: pair[0].lower()))


def machine() -> dict[str, Any]:
    """Name, processor, cores, memory in bytes and system of this machine."""
    system = None
    with contextlib.suppress(OSError):
        system = platform.freedesktop_os_release().get("PRETTY_NAME")
    return {
        "name": platform.node(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "usable_cores": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": system,
    }


class GitState:
    """Commit of a folder; git runs in the background, so that the start does not wait for it."""

    def __init__(self, folder: Path) -> None:
        self._state: dict[str, Any] | None = None
        self._asking = threading.Thread(
            target=self._ask, args=(folder,), name="neuros-git", daemon=True
        )
        self._asking.start()

    def finish(self) -> dict[str, Any] | None:
        """``commit``, and ``is_dirty`` if the folder differs from it; ``None`` outside git."""
        self._asking.join()
        return self._state

    def _ask(self, folder: Path) -> None:
        commit = _git(folder, "rev-parse", "HEAD")
        if commit is None:
            return
        changes = _git(folder, "status", "--porcelain", "--", ".")
        self._state = {
            "commit": commit.strip(),
            "is_dirty": None if changes is None else bool(changes),
        }


def _git(folder: Path, *arguments: str) -> str | None:
    # Variables of a surrounding git command (a hook, say) would lead it to another repository.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    try:
        asked = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(folder), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            timeout=_GIT_PATIENCE_S,
        )
    except (OSError, subprocess.TimeoutExpired):  # there is no git, or its disk does not answer
        return None
    return asked.stdout.decode(errors="replace") if asked.returncode == 0 else None
