"""Small projects whose nodes run in containers, for the tests beside this file."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from deadlines import wait_until
from docker import DockerClient
from endings import GONE_WITHIN_S, KEEP_THE_GIL, dead_shared_memory
from launching import Finished, Running, start

from containers import nothing_left
from neuros.backends.docker.settings import shared_memory
from neuros.backends.run_processes import RUN_ID, RunProcesses
from neuros.backends.sessions import RunOnThisMachine, sessions

HEAD = """
import ctypes, errno, json, os, pathlib, signal, socket, subprocess, sys, time
from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise, neuros_tick
@neuros_finalise()
def save(node):
    (node.run_dir / "saved").touch()
"""
HOLDS_THE_GIL = f"""
@neuros_function()
def hold(node):
    node.get_logger().info("running")
    {KEEP_THE_GIL}
"""


class ContainerBench:
    """A folder in which a test writes its project and runs it in containers."""

    def __init__(self, folder: Path, engine: DockerClient) -> None:
        self.folder = folder
        self.engine = engine
        self.began_s = time.time()
        self.running: list[Running] = []
        self.runs: set[str] = set()

    def project(self, plugins: dict[str, str], **keys: dict[str, Any]) -> None:
        """Write a project of nodes that are not connected; ``keys`` are further ones, by node."""
        for name, plugin in plugins.items():
            (self.folder / f"{name}.py").write_text(HEAD + plugin)
        nodes = [
            {
                "name": name,
                "container": "neuros_python",
                "plugin": f"{name}.py",
                **keys.get(name, {}),
            }
            for name in plugins
        ]
        (self.folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": []}))

    def start(self, *arguments: str, **environment: str) -> Running:
        """Start it; it is ended with the test."""
        running = start(
            self.folder, "--backend", "docker", *arguments, cwd=self.folder, **environment
        )
        self.running.append(running)
        return running

    def launch(self, *arguments: str, **environment: str) -> Finished:
        """Run it to its end."""
        return self.start(*arguments, **environment).finish(30.0)

    def start_and_wait(self, *nodes: str) -> Running:
        """Start it, until all these nodes have said that they run."""
        running = self.start()
        for node in nodes:
            running.wait_for(f"[{node}]: running", 30.0)
        self.runs.add(self.session(running).run)
        return running

    def session(self, running: Running) -> RunOnThisMachine:
        """The run of a launcher."""
        return next(each for each in sessions() if each.launcher[0] == running.process.pid)

    def kill(self, running: Running, node: str, number: int) -> None:
        """Send a signal to the Python of a node, past the engine."""
        found = RunProcesses(self.session(running).run).nodes()
        os.kill(max(pid for pid, name in found.items() if name == node), number)

    def has_saved(self, *names: str) -> bool:
        """Whether the finalise hooks of these nodes have run."""
        return {path.parent.name for path in self.folder.rglob("saved")} == set(names)

    def left(self) -> list[str]:
        """What is left of runs: processes, containers, sockets, shared memory."""
        containers = self.engine.api.containers(all=True, filters={"label": "neuros.run"})
        return [
            *(f"{RUN_ID}={run}" for run in self.runs if RunProcesses(run).alive()),
            *(name for each in containers if self._is_mine(each) for name in each["Names"]),
            *map(str, self.folder.rglob("control.sock")),
            *(str(folder) for run in self.runs if (folder := shared_memory(run)).exists()),
            *dead_shared_memory(self.began_s),
        ]

    def _is_mine(self, container: dict[str, Any]) -> bool:
        return Path(container["Labels"]["neuros.run_folder"]).is_relative_to(self.folder)


@contextmanager
def container_bench(folder: Path) -> Iterator[ContainerBench]:
    """A bench; afterwards all that was started on it has ended, and left nothing."""
    with nothing_left(folder) as engine:
        bench = ContainerBench(folder, engine)
        try:
            yield bench
        finally:
            for running in bench.running:
                running.close()
        wait_until(lambda: not bench.left(), GONE_WITHIN_S)
