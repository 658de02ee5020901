"""The folder that a run leaves behind.

::

    runs/<project>/<utc time>/     or exactly what -o names
        project.json               the expanded project
        run.json                   how the run went
        launcher.log               stacks that are too long for the console
        <node>/node.json           what the node was told
        <node>/node.log            what it printed and logged
        <node>/...                 what its plugin wrote to node.run_dir
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from neuros.api.plan import Plan
from neuros.backends.reaper import Reaper
from neuros.backends.sidecars import Recorded, RecorderProcess
from neuros.distribution import WORKSPACE, __version__, python_command
from neuros.errors import UsageError
from neuros.project.model import Folders, NodeFile, Project
from neuros.project.split import node_file_text, project_to_json
from neuros.recording.provenance import seeds
from neuros.recording.recording_plan import BAG_NAME, RecordingPlan, plan_recording

LAUNCHER_LOG = "launcher.log"


def run_folder_path(
    output: str | os.PathLike[str] | None, project_name: str, time: str | None = None
) -> Path:
    """Where a run goes: ``output``, else a folder of the project and ``time`` (now, in UTC)."""
    if output is not None:
        return Path(output).absolute()
    stamp = time or datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%S.%fZ")
    return Path.cwd() / "runs" / project_name / stamp


def make_run_folder(output: str | os.PathLike[str] | None, project_name: str) -> Path:
    """Create the folder of a run, which only its user can read.

    Raises:
        UsageError: if it exists and is not empty, or cannot be created.
    """
    folder = run_folder_path(output, project_name)
    try:
        if output is not None and _is_taken(folder):
            raise UsageError(f"-o {os.fspath(output)}: is not an empty folder; name a new one")
        folder.mkdir(0o700, parents=True, exist_ok=output is not None)
    except OSError as error:
        raise UsageError(
            f"the run folder {folder} cannot be made ({error.strerror}): name another with -o"
        ) from error
    return folder


def _is_taken(folder: Path) -> bool:
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def folders_of(plan: Plan, run_folder: Path) -> Folders:
    """What the nodes may read and write."""
    return Folders(plan.project.folder, WORKSPACE, run_folder)


def removed_folders(files: Sequence[NodeFile], run_folder: Path) -> list[str]:
    """A sentence for each folder of a run that was removed, or moved, since its nodes have begun.

    What nodes write later makes folders again, so their files tell it.
    """
    names = [file.node.name for file in files]
    gone = [name for name in names if _is_gone(run_folder / name / "node.json")]
    folders = [run_folder] if gone == names else [run_folder / name for name in gone]
    return [
        f"{folder} was removed while the run went on: what was written there before is lost"
        for folder in folders
    ]


def _is_gone(file: Path) -> bool:
    try:
        file.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:  # a node may have shut its folder
        return False
    return False


def write_node_files(plan: Plan, run_folder: Path) -> list[NodeFile]:
    """Write the expanded project and one ``node.json`` per node.

    Raises:
        UsageError: if the folder cannot be written to, or another run has just begun there.
    """
    files = plan.node_files(folders_of(plan, run_folder))
    try:
        # Two runs that were given the same empty folder: only one of them gets it.
        with open(run_folder / "project.json", "x", encoding="utf-8") as expanded:
            expanded.write(json.dumps(project_to_json(plan.project), indent=2) + "\n")
        for file in files:
            (run_folder / file.node.name).mkdir(exist_ok=True)
            path = run_folder / file.node.name / "node.json"
            seen = plan.deployment.as_seen(file)
            path.touch(0o600)  # wherever the folder is: it holds the environment
            path.write_text(node_file_text(seen), "utf-8")
    except FileExistsError as error:
        raise UsageError(
            f"{run_folder}: another run has just begun there; name a new one"
        ) from error
    except OSError as error:
        raise UsageError(
            f"{run_folder} cannot be written to ({error.strerror}): name another folder with -o"
        ) from error
    return files


# ---------------------------------------------------------------------- recording
#
# The recording of a run: planned before the start, reported after the end.


_PACKAGES = ("ros-jazzy-rclpy", "rosbags", "mujoco", "nest-simulator", "numpy")


class Recording:
    """What is recorded of one run, and the process that does it.

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
        reaper: Reaper,
    ) -> None:
        self._plan = replace(plan, custom={**plan.custom, "run_id": run_id})
        self._run = run
        try:
            self._plan.save(run)
        except OSError as error:
            raise UsageError(
                f"{run} cannot be written to ({error.strerror}): name another folder with -o"
            ) from error
        command = python_command("neuros.cli", "recorder", str(run))
        self._process = RecorderProcess(command, run, log_of(run), environment)
        reaper.watch(self._process.pid)

    def finish(self, signals: Sequence[int]) -> Recorded:
        """Have the bag completed; who has no patience for that sends another signal."""
        before = len(signals)
        return self._process.finish(lambda: len(signals) > before)

    def report(self, recorded: Recorded, record: dict[str, Any]) -> list[str]:
        """Put into the record what was recorded; returns what is missing, a sentence each."""
        topics = self._topics(recorded, record)
        problems = list(recorded.problems)
        if recorded.counts:  # else the recorder has stopped, and said so
            problems += _missing(
                {
                    name: topic
                    for name, topic in topics.items()
                    if not any(text.startswith(f"{name} ") for text in recorded.problems)
                }
            )
        record["recording"] = {
            "bag": str(self._run / BAG_NAME),
            "storage": "mcap",
            "topics": topics,
            "problems": problems,
        }
        return problems

    def _topics(self, recorded: Recorded, record: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Per topic the packets in the bag, and those that passed this run."""
        passed = {c["connection"]: _passed(c) for c in record["connections"]}
        planned = {topic.name: topic for topic in self._plan.topics}
        topics = {}
        for name in dict.fromkeys([*planned, *recorded.counts]):
            topic = planned.get(name)
            connection = None if topic is None else topic.connection
            topics[name] = {
                "connection": connection,
                "recorded": recorded.counts.get(name, 0),
                "passed": None if connection is None else passed.get(connection),
                "is_lossy": bool(connection and topic and not topic.is_reliable),
            }
        return topics


def recording_of(plan: Plan, environ: Mapping[str, str]) -> RecordingPlan | None:
    """What is recorded of a run, ``None``: nothing.

    Raises:
        UsageError: if something is to be recorded that is not there.
    """
    wanted = plan.request.recording
    if wanted is None:
        return None
    is_open = plan.needs_known_domain or plan.request.domain_id is not None
    return plan_recording(
        plan.project,
        plan.names,
        wanted,
        is_alone=not is_open and "ROS_DOMAIN_ID" not in environ,
        custom=_custom_data(plan.project),
    )


def log_of(run: Path) -> Path:
    """Where the recorder writes what it has to say."""
    return run / "recorder.log"


def summary(report: Mapping[str, Any]) -> str:
    """One or two lines for the end of a run."""
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


def _missing(topics: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What has passed this run and is not in the bag, a sentence each."""
    return [
        f"{topic['passed'] - topic['recorded']} of {topic['passed']} packets of {name} are not in"
        " the bag"
        for name, topic in topics.items()
        if topic["passed"] is not None and topic["recorded"] < topic["passed"]
    ]


def _passed(connection: Mapping[str, Any]) -> int | None:
    """The packets that passed this run on a connection: sent, or received from elsewhere."""
    sent = connection["sent"]
    found: int | None = connection["received"] if sent is None else sent
    return found


def _custom_data(project: Project) -> dict[str, str]:
    """What the metadata of the bag says about the run; each value is text."""
    content = json.dumps(project_to_json(project), sort_keys=True)
    versions = {"neuros": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "project": project.name,
        "project_sha256": hashlib.sha256(content.encode()).hexdigest(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": json.dumps(versions),
        "seeds": json.dumps(
            {
                f"{node}.{name}": value
                for node, variables in seeds(project.nodes).items()
                for name, value in variables.items()
            }
        ),
    }
