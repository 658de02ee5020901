"""What is made once and kept: where it lies, and who makes it."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

UNUSED_S = 30 * 24 * 3600.0
"""What no run has used for so long is removed."""


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
        False if somebody else holds it, and ``wait`` is false.
    """
    descriptor = _lock(path, wait)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            # While it is locked: whoever waits for it then sees that it is no longer the file.
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
