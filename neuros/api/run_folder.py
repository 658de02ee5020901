"""The folder that a run leaves behind.

::

    runs/<project>/<utc time>/     or exactly what -o names
        project.json               the expanded project
        run.json                   how the run went
        <node>/node.json           what the node was told
        <node>/node.log            what it printed and logged
        <node>/...                 what its plugin wrote to node.run_dir
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from neuros.api.plan import Plan
from neuros.distribution import WORKSPACE
from neuros.errors import UsageError
from neuros.project.model import Folders, NodeFile
from neuros.project.split import node_file_to_json, project_to_json


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
            f"the run folder {folder} cannot be made ({error.strerror}): name one with -o"
        ) from error
    return folder


def _is_taken(folder: Path) -> bool:
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def folders_of(plan: Plan, run_folder: Path) -> Folders:
    """What the nodes may read and write."""
    return Folders(plan.project.folder, WORKSPACE, run_folder)


def write_node_files(plan: Plan, run_folder: Path) -> list[NodeFile]:
    """Write the expanded project and one ``node.json`` per node.

    Raises:
        UsageError: if the folder cannot be written to, or another run has just begun there.
    """
    files = _with_keys(plan.node_files(folders_of(plan, run_folder)))
    try:
        # Two runs that were given the same empty folder: only one of them gets it.
        with open(run_folder / "project.json", "x", encoding="utf-8") as expanded:
            expanded.write(_text(project_to_json(plan.project)))
        for file in files:
            (run_folder / file.node.name).mkdir(exist_ok=True)
            path = run_folder / file.node.name / "node.json"
            seen = plan.deployment.as_seen(file)
            path.touch(0o600)  # wherever the folder is: it holds keys
            path.write_text(_text(node_file_to_json(seen)), "utf-8")
    except FileExistsError as error:
        raise UsageError(
            f"{run_folder}: another run has just begun there; name a new one"
        ) from error
    except OSError as error:
        raise UsageError(
            f"{run_folder} cannot be written to ({error.strerror}): name another folder with -o"
        ) from error
    return files


def _with_keys(files: Sequence[NodeFile]) -> list[NodeFile]:
    """The files with a key for each connection between two of their nodes."""
    here = {file.node.name for file in files}
    within = {
        c.index
        for file in files
        for c in file.connections
        if {c.source_node, c.destination_node} <= here
    }
    keys = {index: secrets.token_hex(16) for index in within}
    return [
        replace(f, keys={c.index: keys[c.index] for c in f.connections if c.index in keys})
        for f in files
    ]


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=2) + "\n"
