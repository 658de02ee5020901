"""The folder of a sweep: whose it is, and what lies in it of earlier parts of the sweep."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from neuros.api.project import Project
from neuros.caching import locked
from neuros.errors import UsageError

_PLAN_NAME = "sweep.json"
_LOCK_NAME = ".sweep.lock"  # there while a sweep goes on


def sweep_folder(
    project: Project, output: str | os.PathLike[str] | None, options: Mapping[str, Any]
) -> Path:
    """The sweep's folder, new or that of an earlier part of it. Raises ``UsageError``."""
    stamp = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%SZ")
    folder = Path(output or Path("runs", project.name, f"sweep-{stamp}")).absolute()
    plan = {
        "project": str(project.file),
        "project_sha256": hashlib.sha256(project.text().encode()).hexdigest(),
        **{name: str(options[name]) for name in ("backend", "duration", "record")},
    }
    file = folder / _PLAN_NAME
    try:
        if file.exists():
            _check_same(json.loads(file.read_text("utf-8")), plan, folder)
            return folder
        if folder.exists() and any(folder.iterdir()):
            raise UsageError(f"{folder}: is neither empty nor a sweep; name another folder with -o")
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(plan, indent=2) + "\n", "utf-8")
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder} cannot be used ({error}): name another one with -o") from error
    return folder


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep others from the folder: to them, runs that go on are cut off. Raises ``UsageError``."""
    with contextlib.ExitStack() as stack:
        try:
            is_alone = stack.enter_context(locked(folder / _LOCK_NAME, wait=False))
        except OSError as error:
            raise UsageError(
                f"{folder} cannot be used ({error}): name another one with -o"
            ) from error
        if not is_alone:
            raise UsageError(f"{folder}: a sweep goes on there; wait for its end, or name another")
        yield


def _check_same(before: Mapping[str, Any], now: Mapping[str, Any], folder: Path) -> None:
    for name, value in now.items():
        if before.get(name) != value:
            what = "the project's files" if name == "project_sha256" else f"its {name}"
            raise UsageError(
                f"{folder} holds a sweep that is not this one ({what} differ):"
                " name another folder with -o"
            )


def set_aside(folder: Path) -> None:
    """Rename what a run has left that was cut off."""
    number = 1
    while (aside := folder.with_name(f"{folder.name}.unfinished-{number}")).exists():
        number += 1
    folder.rename(aside)
