"""Cached folders: built once under a lock, used by many runs, removed when unused."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

KEY_LENGTH = 12
"""Digits of the digest in the name of what is kept."""

UNUSED_S = 30 * 24 * 3600.0
"""What no run has used for so long is removed."""

_NAME = re.compile(rf"(.+-[0-9a-f]{{{KEY_LENGTH}}})(?![^.])")


@dataclass(frozen=True)
class Kept:
    """A folder ``<name>-<key>`` that is made once, or will be, with files beside it.

    Attributes:
        folder: what is kept; the others are called like it, with a suffix.
    """

    folder: Path

    @property
    def log(self) -> Path:
        """What was written while it was made."""
        return self.beside(".log")

    def beside(self, suffix: str) -> Path:
        """The file or folder of its name with a suffix."""
        return self.folder.with_name(self.folder.name + suffix)

    def locked(self, *, wait: bool = True) -> contextlib.AbstractContextManager[bool]:
        """Be the only one who makes or removes it. Raises ``OSError``.

        The context is False if another process is, and ``wait`` is false.
        """
        return locked(self.beside(".lock"), wait=wait)


def kept_in(cache: Path) -> list[Path]:
    """The folders that are kept in a cache, also those of which only files beside are left."""
    names = {match[1] for path in cache.glob("*") if (match := _NAME.match(path.name))}
    return [cache / name for name in sorted(names)]


def cache_root(environ: Mapping[str, str]) -> Path:
    """NeuROS's own folder among the caches of the user (XDG Base Directory Specification)."""
    base = environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):
        base = os.path.join(environ.get("HOME") or "/", ".cache")
    return Path(base) / "neuros"


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold the lock that a file stands for, which is there only meanwhile. Raises ``OSError``.

    Yields:
        False if another process holds it, and ``wait`` is false.
    """
    descriptor = _lock(path, wait)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            # Removed while locked: a process that waits then sees that its file is gone.
            path.unlink(missing_ok=True)
            os.close(descriptor)


def _lock(path: Path, wait: bool) -> int | None:
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        # Writable, without which network file systems give no exclusive lock.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if os.path.samestat(os.fstat(descriptor), os.lstat(path)):
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except FileNotFoundError:
            pass  # its holder has just removed it
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
