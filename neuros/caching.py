"""Cached folders: built once under a lock, used by many runs, removed when unused."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

KEY_LENGTH = 12
"""Digits of the digest in the name of a kept folder."""

UNUSED_S = 30 * 24 * 3600.0
"""Seconds after which an unused folder is removed."""

_NAME = re.compile(rf"(.+-[0-9a-f]{{{KEY_LENGTH}}})(?![^.])")


@dataclass(frozen=True)
class Kept:
    """A folder ``<name>-<key>`` that is built once, and files beside it: its name with a suffix."""

    folder: Path

    @property
    def log(self) -> Path:
        return self.beside(".log")

    @property
    def draft(self) -> Path:
        """The folder in which it is built, or removed: half of it must not count as whole."""
        return self.beside(".draft")

    @property
    def mark(self) -> Path:
        """The path that exists if it is whole; its time is that of the last use."""
        return self.folder

    def remove(self) -> None:
        """Remove what can be removed, but not the log."""
        with contextlib.suppress(OSError):
            self.folder.rename(self.draft)
        shutil.rmtree(self.draft, ignore_errors=True)

    def beside(self, suffix: str) -> Path:
        return self.folder.with_name(self.folder.name + suffix)

    def locked(self, *, wait: bool = True) -> contextlib.AbstractContextManager[bool]:
        """Lock the folder for its build or removal, as :func:`locked`."""
        return locked(self.beside(".lock"), wait=wait)

    def build(self, make: Callable[[], object], on_wait: Callable[[], object]) -> None:
        """Call ``make`` with the lock held; ``on_wait`` before, if another process holds it.

        ``make`` returns at once where the other process has built the folder. Raises ``OSError``.
        """
        with self.locked(wait=False) as is_mine:
            if is_mine:
                make()
                return
        on_wait()
        with self.locked():
            make()


def kept_in(cache: Path) -> list[Path]:
    """The kept folders of a cache, also those of which only files beside are left."""
    names = {match[1] for path in cache.glob("*") if (match := _NAME.match(path.name))}
    return [cache / name for name in sorted(names)]


def sweep(cache: Path, kind: type[Kept] = Kept) -> None:
    """Remove folders that were interrupted, and folders and logs that are unused for a month."""
    oldest_s = time.time() - UNUSED_S
    for entry in map(kind, kept_in(cache)):
        with contextlib.suppress(OSError), entry.locked(wait=False) as is_mine:
            if not is_mine:
                continue
            shutil.rmtree(entry.draft, ignore_errors=True)
            used_s = 0.0  # for a folder that is not whole
            if entry.mark.exists():
                used_s = entry.mark.stat().st_mtime
            elif entry.log.exists() and not entry.folder.exists():
                used_s = entry.log.stat().st_mtime
            if used_s < oldest_s:
                entry.remove()
                entry.log.unlink(missing_ok=True)


def cache_root(environ: Mapping[str, str]) -> Path:
    """NeuROS's own folder among the caches of the user (XDG Base Directory Specification)."""
    base = environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):
        base = os.path.join(environ.get("HOME") or "/", ".cache")
    return Path(base) / "neuros"


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold a lock; its file exists meanwhile. Raises ``OSError``.

    Yields:
        False if another process holds it, and ``wait`` is false.
    """
    descriptor = _lock(path, wait)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            # Removed while locked: a waiting process sees that its file is gone.
            path.unlink(missing_ok=True)
            os.close(descriptor)


def _lock(path: Path, wait: bool) -> int | None:
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        # Network file systems lock only writable files exclusively.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if os.path.samestat(os.fstat(descriptor), os.lstat(path)):
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except FileNotFoundError:
            pass  # the holder has just removed it
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
