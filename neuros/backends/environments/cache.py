"""Cache of virtual environments: made, being made, and unused ones.

::

    ~/.cache/neuros/environments/     (or $XDG_CACHE_HOME/neuros/environments)
        <container>-<key>/            a virtual environment
        <container>-<key>.json        says that it is whole, and which Python to run
        <container>-<key>.lock        only while somebody makes it
        <container>-<key>.log         what pip wrote

The ``.json`` is written last, in one step: what was interrupted never looks whole. There are some
without a folder: they remember that the launcher's own environment does, which saves the next
start from reading the metadata of packages.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from neuros.caching import UNUSED_S, Kept, cache_root, kept_in


def cache_folder(environ: Mapping[str, str]) -> Path:
    """The folder of all environments."""
    return cache_root(environ) / "environments"


@dataclass(frozen=True)
class Entry(Kept):
    """One environment, made or not; the log has what pip wrote."""

    @property
    def stamp(self) -> Path:
        return self.beside(".json")

    @property
    def future_python(self) -> Path:
        """The Python in it, once it is made."""
        return self.folder / "bin" / "python"

    def python(self) -> Path | None:
        """The Python to run, if that has been settled and is there."""
        try:
            is_here = json.loads(self.stamp.read_text("utf-8"))["is_here"]
        except (OSError, ValueError, LookupError, TypeError):
            return None
        python = Path(sys.executable) if is_here else self.future_python
        return python if os.access(python, os.X_OK) else None

    def note_use(self) -> None:
        """Keep it from being removed as unused."""
        with contextlib.suppress(OSError):
            os.utime(self.stamp)

    def settle(self, *, is_here: bool) -> None:
        """From now on it is whole; or, where ``is_here``, the launcher's own Python does.

        Raises ``OSError``.
        """
        self.stamp.parent.mkdir(parents=True, exist_ok=True)
        draft = self.beside(f".json.{os.getpid()}")
        try:
            draft.write_text(json.dumps({"is_here": is_here}), "utf-8")
            draft.replace(self.stamp)
        finally:
            draft.unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove it, as far as that is possible; the log stays."""
        with contextlib.suppress(OSError):
            for file in self.folder.parent.glob(f"{self.folder.name}.json*"):
                file.unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)


def sweep(cache: Path) -> None:
    """Remove what was interrupted, and what no run has used for a month."""
    oldest_s = time.time() - UNUSED_S
    for entry in map(Entry, kept_in(cache)):
        with contextlib.suppress(OSError), entry.locked(wait=False) as is_mine:
            if is_mine and _last_used_s(entry) < oldest_s:
                entry.remove()
                entry.log.unlink(missing_ok=True)


def _last_used_s(entry: Entry) -> float:
    """When a run last used it; 0 for a folder that is not whole."""
    try:
        return entry.stamp.stat().st_mtime
    except FileNotFoundError:
        is_log_alone = not entry.folder.exists() and entry.log.exists()
        return entry.log.stat().st_mtime if is_log_alone else 0.0
