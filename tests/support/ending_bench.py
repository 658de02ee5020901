"""A bench for tests of endings: projects are written, run, and leave nothing behind."""

from __future__ import annotations

import contextlib
import json
import re
import time
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

from endings import GONE_WITHIN_S, dead_shared_memory, is_stale
from launching import Finished, Running, launch, start

MARK = "NEUROS_TEST_ENDING"
HEAD = """
import ctypes, os, signal, sys, threading, time
from neuros.hooks import (All, Optional, neuros_finalise, neuros_function, neuros_initialise,
                          neuros_tick)
def note(node, text):
    (node.run_dir / text).touch()
@neuros_finalise()
def save(node):
    note(node, "saved")
    node.get_logger().info("all is saved")
"""
ENDS = """
@neuros_tick(seconds=0.1)
def end(node):
    node.shutdown("enough")
"""
SOURCE = """
@neuros_tick(seconds=0.002, outputs="o")
def send(node):
    return node.make_packet("o")
"""
RELAY = """
@neuros_function(inputs="x", outputs="o")
def relay(node, x):
    return x
"""
SINK = """
@neuros_function(inputs="x")
def take(node, x):
    pass
"""
COUNTS = """
@neuros_function(inputs="x")
def count(node, x):
    node.set_user_data((node.get_user_data() or 0) + 1)
    if node.get_user_data() == 50:
        node.shutdown("enough")
"""


class Bench:
    """A folder in which a test writes its project and runs it."""

    def __init__(self, folder: Path, back_end: str) -> None:
        self.folder = folder
        self.back_end = back_end
        self.mark = uuid.uuid4().hex
        self.began_s = time.time()
        self.outputs: list[str] = []
        self.running: list[Running] = []

    def project(self, *connections: str | tuple[str, int | None], **plugins: str) -> Path:
        """Write a project; ``"a.out -> b.in"`` is lossless, ``(..., None)`` best effort."""
        wires = [c if isinstance(c, tuple) else (c, 0) for c in connections]
        ends = [(*re.split(r" -> |\.", wire), limit) for wire, limit in wires]
        for name, plugin in plugins.items():
            (self.folder / f"{name}.py").write_text(HEAD + plugin)
        nodes = [
            {
                "name": name,
                "container": "neuros_python",
                "plugin": f"{name}.py",
                "outputs": _ports(out for source, out, _, _, _ in ends if source == name),
                "inputs": _ports(
                    into for _, _, destination, into, _ in ends if destination == name
                ),
            }
            for name in plugins
        ]
        keys = ("source_node", "source_output", "destination_node", "destination_input")
        joined = [
            dict(zip(keys, end[:4], strict=True))
            | ({} if end[4] is None else {"discard_limit": end[4]})
            for end in ends
        ]
        file = self.folder / "project.json"
        file.write_text(json.dumps({"nodes": nodes, "connections": joined}))
        return file

    def launch(self, *arguments: str, timeout_s: float = 20.0) -> Finished:
        """Run the project to its end."""
        finished = launch(
            self.folder,
            *self._arguments(arguments),
            cwd=self.folder,
            timeout_s=timeout_s,
            **{MARK: self.mark},
        )
        self.outputs.append(finished.output)
        return finished

    def start(self, *arguments: str, program: Sequence[str] = ()) -> Running:
        """Start it, by ``program`` in place of ``neuros launch``; it is ended with the test."""
        running = start(
            self.folder,
            *self._arguments(arguments),
            cwd=self.folder,
            program=program,
            **{MARK: self.mark},
        )
        self.running.append(running)
        return running

    def _arguments(self, arguments: Sequence[str]) -> Sequence[str]:
        return ("--backend", self.back_end, *arguments)

    def saved(self, *names: str) -> bool:
        """Whether the finalise hooks of these nodes have run, and logged that they have."""
        folders = {path.parent for path in self.folder.rglob("saved")}
        return {folder.name for folder in folders} == set(names) and all(
            "all is saved" in (folder / "node.log").read_text() for folder in folders
        )

    def pid_of(self, node: str) -> int:
        """The process that a node runs in."""
        for pid, environment, command in _processes():
            if f"{MARK}={self.mark}" in environment and f"/{node}/node.json" in command:
                return pid
        raise AssertionError(f"no process of {node}")

    def is_anything_left(self) -> str:
        """Names what is left of the runs, or nothing."""
        for pid, environment, command in _processes():
            if f"{MARK}={self.mark}" in environment:
                return f"process {pid}: {command}"
        for socket in self.folder.rglob("control.sock"):
            return str(socket)
        for domain in re.findall(r"ROS domain (\d+) \(first free", "".join(self.outputs)):
            if is_stale(Path(f"/tmp/neuros-domain-{domain}.lock")):
                return f"the lock file of domain {domain}"
        return " ".join(dead_shared_memory(self.began_s))


def _ports(names: Iterator[str]) -> list[dict[str, str]]:
    return [{"name": name, "type": "std_msgs/msg/Int32"} for name in dict.fromkeys(names)]


def _processes() -> Iterator[tuple[int, list[str], str]]:
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            environment = (folder / "environ").read_bytes().decode(errors="replace").split("\0")
            command = (folder / "cmdline").read_bytes().decode(errors="replace")
            if environment != [""] or command:  # else it is a zombie
                yield int(folder.name), environment, command.replace("\0", " ").strip()


@contextlib.contextmanager
def made_bench(folder: Path, back_end: str) -> Iterator[Bench]:
    """A bench; afterwards all that was started on it has ended, and left nothing."""
    bench = Bench(folder, back_end)
    try:
        yield bench
    finally:
        for running in bench.running:
            running.close()
            bench.outputs.append(running.output)
    deadline_s = time.monotonic() + GONE_WITHIN_S
    while (left := bench.is_anything_left()) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert not left


def last_line(finished: Finished) -> str:
    return finished.said("neuros")[-1]


def assert_ended(finished: Finished, exit_code: int, reason: str) -> None:
    """The exit code, and what is printed last and stands in ``run.json``."""
    assert finished.exit_code == exit_code, finished.output
    assert re.fullmatch(reason, last_line(finished)), finished.output
    assert finished.output.rstrip().endswith(last_line(finished))
    assert finished.record["exit_code"] == exit_code
    assert finished.record["reason"] == last_line(finished)
