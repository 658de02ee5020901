"""The folder that a run leaves behind.

::

    runs/<project>/<utc time>/     or exactly what -o names
        project.json               the expanded project
        run.json                   the record of the run
        launcher.log               its records, and stacks that are too long for the console
        <node>/node.json           project, connections and settings of the node
        <node>/node.log            its output and log
        <node>/kept/               what its plugin keeps, restored/: what was restored to it
        <node>/plugin/             the plugin file, if a program gave functions
        <node>/...                 files that its plugin wrote to node.run_dir
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.api.kept import copy_sources
from neuros.api.plan import Plan
from neuros.api.plugin_text import PluginText
from neuros.api.run_record import EXIT_ENVIRONMENT
from neuros.backends.sidecars import Recorded, RecorderProcess
from neuros.distribution import WORKSPACE, __version__, python_command
from neuros.errors import UsageError
from neuros.project.model import Folders, NodeFile
from neuros.project.split import node_file_text, project_to_json
from neuros.project.timing import seeds
from neuros.recording.recording_plan import BAG_NAME, RecordingPlan, plan_recording
from neuros.recording.run_file import RUN_FILE, write_run_file

if TYPE_CHECKING:
    from neuros.launcher.outcome import Outcome

LAUNCHER_LOG = "launcher.log"


def run_folder_path(
    output: str | os.PathLike[str] | None, project_name: str, time: str | None = None
) -> Path:
    """The folder of a run: ``output``, else one named after project and ``time`` (now, in UTC)."""
    if output is not None:
        return Path(output).absolute()
    stamp = time or datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%S.%fZ")
    return Path.cwd() / "runs" / project_name / stamp


def make_run_folder(output: str | os.PathLike[str] | None, project_name: str) -> Path:
    """Create the folder of a run, which only its user can read.

    Raises:
        UsageError: if the folder is not empty, or cannot be created.
    """
    folder = run_folder_path(output, project_name)
    try:
        is_used = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        if output is not None and is_used:
            raise UsageError(f"-o {os.fspath(output)}: is not an empty folder; name a new one")
        folder.mkdir(0o700, parents=True, exist_ok=output is not None)
    except OSError as error:
        raise UsageError(
            f"the run folder {folder} cannot be made ({error.strerror}): name another with -o"
        ) from error
    return folder


def folders_of(plan: Plan, run_folder: Path) -> Folders:
    """The folders that nodes may read or write."""
    return Folders(plan.project.folder, WORKSPACE, run_folder)


def removed_folders(files: Sequence[NodeFile], run_folder: Path) -> list[str]:
    """A sentence for each folder of a run that was removed or moved while the run went on."""
    names, gone = [file.node.name for file in files], []
    for name in names:
        try:  # the file, since a node that writes later makes its folder again
            (run_folder / name / "node.json").lstat()
        except (FileNotFoundError, NotADirectoryError):
            gone.append(name)
        except OSError:  # the node may have closed its folder to others
            pass
    folders = [run_folder] if gone == names else [run_folder / name for name in gone]
    return [
        f"{folder} was removed while the run went on: what was written there before is lost"
        for folder in folders
    ]


def write_node_files(
    plan: Plan, run_folder: Path, *, keeps_functions: bool = False
) -> tuple[Plan, list[NodeFile]]:
    """Write the expanded project, and for each node ``node.json`` and a plugin of functions.

    Args:
        keeps_functions: whether the nodes are in this program, and call the functions themselves.

    Returns:
        The plan with the files of these plugins, and the node files.

    Raises:
        UsageError: if the folder cannot be written to, another run has begun there, or a function
            cannot stand in a file.
    """
    of_functions = [node for node in plan.nodes if node.hooks and not keeps_functions]
    texts = {node.name: PluginText(node.name, node.hooks) for node in of_functions}
    plugins = {name: run_folder / name / "plugin" / f"{name}_plugin.py" for name in texts}
    nodes = (
        replace(node, plugin=plugins[node.name], hooks=()) if node.name in plugins else node
        for node in plan.project.nodes
    )
    plan = replace(plan, project=replace(plan.project, nodes=tuple(nodes)))
    files = plan.node_files(folders_of(plan, run_folder))
    with faults_of(run_folder):
        try:
            # Of two runs that were given the same empty folder, only one gets it.
            (run_folder / "project.json").touch(exist_ok=False)
        except FileExistsError as error:
            raise UsageError(
                f"{run_folder}: another run has just begun there; name a new one"
            ) from error
        expanded = json.dumps(project_to_json(plan.project), indent=2) + "\n"
        (run_folder / "project.json").write_text(expanded, "utf-8")
        for name, text in texts.items():
            text.write(plugins[name])
        for file in files:
            (run_folder / file.node.name).mkdir(exist_ok=True)
            path = run_folder / file.node.name / "node.json"
            seen = plan.deployment.as_seen(file)
            path.touch(0o600)  # it holds the environment, which others must not read
            path.write_text(node_file_text(seen), "utf-8")
        copy_sources(plan.restored, run_folder)
    return plan, files


@contextlib.contextmanager
def faults_of(run_folder: Path) -> Iterator[None]:
    """Raise ``UsageError`` where a run folder cannot be written to."""
    try:
        yield
    except OSError as error:
        raise UsageError(
            f"{run_folder} cannot be written to ({error.strerror}): name another folder with -o"
        ) from error


def save_record(record: dict[str, Any], ended: Outcome, folder: Path, run_id: str) -> None:
    """Write ``run.json``; if the disk is full, into a folder for temporary files."""
    try:
        write_run_file(record, folder)
    except OSError as error:
        spare = Path(tempfile.gettempdir(), f"neuros-{run_id}")
        problem = f"{folder / RUN_FILE} cannot be written ({error.strerror})"
        ended.fail(f"{problem}: it is in {spare} instead, if there is room", EXIT_ENVIRONMENT)
        record |= {"exit_code": ended.exit_code, "reason": ended.reason}
        with contextlib.suppress(OSError):
            spare.mkdir(0o700)
            write_run_file(record, spare)


_PACKAGES = ("ros-jazzy-rclpy", "rosbags", "mujoco", "nest-simulator", "numpy")


class Recording:
    """The recording of one run, and its recorder process.

    Raises:
        UsageError: if the run folder cannot be written to.
        EnvironmentFault: if the recorder cannot be started.
    """

    def __init__(
        self,
        plan: RecordingPlan,
        run_id: str,
        run: Path,
        environment: Mapping[str, str],
    ) -> None:
        self._plan = replace(plan, custom={**plan.custom, "run_id": run_id})
        self._run = run
        with faults_of(run):
            self._plan.save(run)
        command = python_command("neuros.cli", "recorder", str(run))
        self._process = RecorderProcess(command, run, log_of(run), environment)

    def finish(self, signals: Sequence[int]) -> Recorded:
        """Complete the bag; a further signal ends that."""
        before = len(signals)
        return self._process.finish(lambda: len(signals) > before)

    def report(self, recorded: Recorded, record: dict[str, Any]) -> list[str]:
        """Add the recording to the record of the run; returns a sentence for each loss."""
        # Packets that passed this run on a connection: sent, or received from elsewhere.
        passed = {
            c["connection"]: c["received"] if c["sent"] is None else c["sent"]
            for c in record["connections"]
        }
        planned = {topic.name: topic for topic in self._plan.topics}
        topics: dict[str, dict[str, Any]] = {}
        for name in dict.fromkeys([*planned, *recorded.counts]):
            topic = planned.get(name)
            connection = None if topic is None else topic.connection
            topics[name] = {
                "connection": connection,
                "recorded": recorded.counts.get(name, 0),
                "passed": None if connection is None else passed.get(connection),
                "is_lossy": bool(connection and topic and not topic.is_reliable),
            }
        problems = list(recorded.problems)
        if recorded.counts:  # without counts the recorder has stopped, which is a problem already
            problems += [
                f"{topic['passed'] - topic['recorded']} of {topic['passed']} packets of {name} are"
                " not in the bag"
                for name, topic in topics.items()
                if topic["passed"] is not None
                and topic["recorded"] < topic["passed"]
                and not any(text.startswith(f"{name} ") for text in recorded.problems)
            ]
        record["recording"] = {
            "bag": str(self._run / BAG_NAME),
            "storage": "mcap",
            "topics": topics,
            "problems": problems,
        }
        return problems


def recording_of(plan: Plan, environ: Mapping[str, str]) -> RecordingPlan | None:
    """The plan of the recording that a run asks for, ``None``: nothing is recorded.

    Raises:
        UsageError: for a topic that does not exist.
    """
    wanted = plan.request.recording
    if wanted is None:
        return None
    is_open = plan.needs_known_domain or plan.request.domain_id is not None
    content = json.dumps(project_to_json(plan.project), sort_keys=True)
    versions = {"neuros": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    seeded = {
        f"{node}.{name}": value
        for node, variables in seeds(plan.project.nodes).items()
        for name, value in variables.items()
    }
    return plan_recording(
        plan.project,
        plan.names,
        wanted,
        is_alone=not is_open and "ROS_DOMAIN_ID" not in environ,
        custom={  # metadata of the bag: text
            "project": plan.project.name,
            "file": str(plan.project.file),
            "project_sha256": hashlib.sha256(content.encode()).hexdigest(),
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "versions": json.dumps(versions),
            "seeds": json.dumps(seeded),
            "backend": plan.back_end.name,
            "time": plan.project.time,
        },
    )


def log_of(run: Path) -> Path:
    return run / "recorder.log"


def summary(report: Mapping[str, Any]) -> str:
    """The recording in one or two lines, for the end of a run."""
    topics = report["topics"].values()
    count = sum(topic["recorded"] for topic in topics)
    noun = "topic" if len(topics) == 1 else "topics"
    packets = "packet" if count == 1 else "packets"
    lines = [f"recorded {count} {packets} on {len(topics)} {noun}: {report['bag']}"]
    lossy = [topic for topic in topics if topic["is_lossy"]]
    if lossy:
        seen = sum(topic["recorded"] for topic in lossy)
        passed = [topic["passed"] for topic in lossy]
        of = "?" if None in passed else sum(passed)
        lines.append(f"recorded {seen} of {of} packets of connections that may lose any number")
    return "\n".join(lines)
