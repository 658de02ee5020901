"""The process that replays one node, with the Python, the environment and the script of the node.

``neuros replay RUN --node NAME`` becomes it; a replay of several nodes starts one for each.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neuros.api.run_record import PastRun
from neuros.backends.node_command import (
    node_environment,
    process_environment,
    start_arguments,
    start_environment,
    with_messages,
)
from neuros.backends.pythons import Pythons
from neuros.cli.environments import make_shown_environments, require_messages
from neuros.distribution import WORKSPACE, python_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.messages.workspace import message_cache
from neuros.node.keeping import RESTORED
from neuros.ordinary_files import write_whole
from neuros.project.model import NodeFile
from neuros.project.split import node_file_text
from neuros.recording.run_file import read_object
from neuros.registry import ran_in_one_process
from neuros_analysis.replay.from_container import as_on_this_machine, not_here, ran_in_container
from neuros_analysis.replay.recorded_node import RecordedNode, recorded_node

IDENTICAL, DIFFERENT, UNKNOWN, FAILED = "identical", "different", "unknown", "not replayed"


@dataclass(frozen=True)
class NodeVerdict:
    """What the replay of a node has shown.

    Attributes:
        verdict: :data:`IDENTICAL`, :data:`DIFFERENT`, :data:`UNKNOWN` (nothing could be compared)
            or :data:`FAILED` (it could not be replayed here).
        hooks: how many hooks it has executed.
        packets: how many packets were compared, one that has several receivers once for each.
        connections: on how many connections and external topics.
        is_whole: whether the recording reaches the end of the node.
        difference: the first one, in a sentence, or why there is nothing to compare.
        notes: sentences for the user.
    """

    node: str
    verdict: str
    hooks: int = 0
    packets: int = 0
    connections: int = 0
    is_whole: bool = True
    difference: str = ""
    notes: tuple[str, ...] = ()

    def save(self, file: Path) -> None:
        """Write it for the process that asked for it. Raises ``OSError``."""
        write_whole(file, json.dumps(dataclasses.asdict(self)).encode())

    @classmethod
    def read(cls, file: Path) -> NodeVerdict:
        """What :meth:`save` has written. Raises ``FileNotFoundError``."""
        content: dict[str, Any] = read_object(file)
        return cls(**{**content, "notes": tuple(content["notes"])})


@dataclass(frozen=True)
class NodeReplay:
    """A node that can be replayed.

    Attributes:
        file: its ``node.json``, with the paths of this machine.
    """

    run: PastRun
    file: NodeFile

    @property
    def name(self) -> str:
        return self.file.node.name

    def make_python(self) -> tuple[Path, int]:
        """The Python of the node, made if necessary, and the exit code of a signal, else 0.

        Raises:
            EnvironmentFault: if it cannot be made.
        """
        own = [] if ran_in_one_process(self.run.record) else [self.file.node]
        try:
            pythons = Pythons.choose(own, self.file.folders.project, dict(os.environ))
            ended = make_shown_environments(pythons, [])
        except EnvironmentFault as fault:
            is_container = ran_in_container(self.run)
            raise not_here(self.run, self.name, fault) if is_container else fault from fault
        return pythons.paths.get(self.name, Path(sys.executable)), ended

    def start(self, python: Path, folder: Path, options: Sequence[str] = ()) -> ReplayProcess:
        """What to start in a folder, which takes the place of the run folder."""
        own = folder / self.name
        if self.file.restored:
            shutil.copytree(self.run.folder / self.name / RESTORED, own / RESTORED)
        file = replace(self.file, folders=replace(self.file.folders, run=folder))
        own.mkdir(exist_ok=True)  # what was restored to the node is there
        (own / "node.json").write_text(node_file_text(file), "utf-8")
        command = python_command(
            "neuros.cli", "replayed", "--run", str(self.run.folder), *options, python=python
        )
        added = {
            **node_environment(file),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF",  # it has no neighbours
            "ROS_LOG_DIR": str(folder),
        }
        environment = start_environment(
            command, [file], with_messages(process_environment(os.environ, added), file.messages)
        )
        arguments = start_arguments(command, [file])
        arguments[0] = shutil.which(arguments[0]) or arguments[0]
        return ReplayProcess(arguments, environment, folder)


@dataclass(frozen=True)
class ReplayProcess:
    """Arguments, environment and current folder of a process."""

    arguments: list[str]
    environment: dict[str, str]
    folder: Path

    def become(self) -> None:
        """Replace this process by it."""
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os.chdir(self.folder)
        os.execve(self.arguments[0], self.arguments, self.environment)


def replay_of(run: PastRun, name: str, *, is_strict: bool = False) -> NodeReplay:
    """Prepare the replay of a node.

    Args:
        is_strict: whether to refuse what can be replayed, but hardly compared.

    Raises:
        UsageError: if the node or the recording is not there.
        EnvironmentFault: if a file is damaged, or message packages are missing.
    """
    file = as_on_this_machine(run, recorded_node(run, name), WORKSPACE, message_cache(os.environ))
    require_messages(file)
    if not (file.node.module or file.node.plugin.is_file()):
        raise UsageError(f"replay: the plugin of '{name}' is gone: {file.node.plugin}")
    recorded = RecordedNode(run, file)
    if is_strict:
        recorded.check()
    return NodeReplay(run, file)
