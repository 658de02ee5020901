"""The message packages of a run that is over: found again, or built again."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from neuros.api.loading import workspaces_of
from neuros.cli.environments import build_messages
from neuros.errors import UsageError
from neuros.messages.cache import message_cache
from neuros.messages.needed import Messages
from neuros.project.model import NodeFile


def require_messages(file: NodeFile) -> None:
    """See to it that the packages of a recorded node are there: built anew if they were removed.

    Raises:
        UsageError: if one is gone, and its files are not those of the run any more.
        EnvironmentFault: if it cannot be built.
    """
    missing = [python for python in file.messages if not python.is_dir()]
    if not missing:
        return
    workspaces = workspaces_of(file.folders.project)
    messages = Messages(workspaces, _names(missing))
    for python in missing:
        if python not in messages.paths:
            (name,) = _names([python])
            raise UsageError(
                f"replay: message package '{name}' has changed since the run, and what was built"
                f" for that is gone: {python.parent}"
            )
    build_messages(messages)


def find_messages_of(run: Path) -> None:
    """Let this very process find the packages of a run, given its folder or its bag."""
    for folder in (run, run.parent):
        for file in folder.glob("*/node.json"):
            with suppress(OSError, ValueError):
                content = json.loads(file.read_text("utf-8"))
                entries = (Path(path).parent.name for path in content.get("messages", ()))
                paths = [str(message_cache(os.environ) / entry / "python") for entry in entries]
                sys.path[:0] = [path for path in paths if path not in sys.path]
            return


def _names(pythons: Iterable[Path]) -> list[str]:
    return [python.parent.name.rpartition("-")[0] for python in pythons]
