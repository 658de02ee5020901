"""The cache of built packages.

::

    ~/.cache/neuros/messages/         (or $XDG_CACHE_HOME/neuros/messages)
        <package>-<key>/              a built package, whole from its first moment
            python/<package>/         what Python imports
            lib/                      its C libraries
            share/<package>/          definitions, and type descriptions with their hashes
            include/<package>/        headers, for packages that depend on it
        <package>-<key>.lock          only while it is being built
        <package>-<key>.log           what the generators and the compiler wrote, after a failure

A package is built in a folder beside, which gets its name when it is whole. The libraries of one
find those of another by the path between their folders: the cache can be anywhere.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from neuros.caching import KEY_LENGTH, UNUSED_S, Kept, cache_root, kept_in


def message_cache(environ: Mapping[str, str]) -> Path:
    """The folder of built packages."""
    return cache_root(environ) / "messages"


@dataclass(frozen=True)
class Built(Kept):
    """One package, built or not; the log has what the generators and the compiler wrote."""

    @property
    def package(self) -> str:
        """The name of the package."""
        return self.folder.name[: -KEY_LENGTH - 1]

    @property
    def python(self) -> Path:
        """The folder for Python's path."""
        return self.folder / "python"

    @property
    def share(self) -> Path:
        return self.folder / "share" / self.package

    @property
    def draft(self) -> Path:
        """The folder in which it is built."""
        return self.beside(".draft")

    @property
    def is_there(self) -> bool:
        return self.folder.is_dir()

    def note_use(self) -> None:
        """Keep it from being removed as unused."""
        with contextlib.suppress(OSError):
            os.utime(self.folder)


def sweep(cache: Path) -> None:
    """Remove what was interrupted, and what no run has used for a month."""
    oldest_s = time.time() - UNUSED_S
    for built in map(Built, kept_in(cache)):
        with contextlib.suppress(OSError), built.locked(wait=False) as is_mine:
            if is_mine:
                shutil.rmtree(built.draft, ignore_errors=True)
                _remove_if_older(built, oldest_s)


def _remove_if_older(built: Built, oldest_s: float) -> None:
    if built.is_there and built.folder.stat().st_mtime < oldest_s:
        built.folder.rename(built.draft)  # gone at once: half of it must not count as built
        shutil.rmtree(built.draft, ignore_errors=True)
    if built.log.exists() and built.log.stat().st_mtime < oldest_s:
        built.log.unlink()
