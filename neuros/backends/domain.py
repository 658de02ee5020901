"""Chooses the ROS domain of a run, and locks it against other runs.

A run locks the file ``neuros-domain-<id>.lock`` in the temporary folder of the machine (``flock``).
The lock ends with the launcher and its guardian, which hold it both, also by SIGKILL. Runs that
chose the first free domain hold it exclusively; runs that were given a domain share it, so that
they may join each other and no other run chooses it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from neuros.backends.guardian_program import is_same_file, remove_lock
from neuros.errors import EnvironmentFault, UsageError

AUTOMATIC = range(1, 102)
"""Domains to pick from: up to 101 their ports stay below those that Linux gives out itself."""
_HIGHEST = 232
_UDP_TABLES = (Path("/proc/net/udp"), Path("/proc/net/udp6"))


class FileLock:
    """A locked file.

    Attributes:
        path: the file, or ``None`` if there is none; removed on release.
    """

    def __init__(self, lock: tuple[Path, int] | None = None) -> None:
        self.path: Path | None = lock[0] if lock else None
        self._descriptor: int | None = lock[1] if lock else None

    def fileno(self) -> int | None:
        """The locked file descriptor, which the guardian holds as well; ``None`` without lock."""
        return self._descriptor

    def release(self) -> None:
        """Unlock the file; a second call has no effect."""
        if self._descriptor is None or self.path is None:
            return
        remove_lock(self._descriptor, self.path)
        os.close(self._descriptor)
        self._descriptor = None


class DomainLock(FileLock):
    """A ROS domain, held while this is open.

    Attributes:
        id: the domain id.
        reason: what to print, "ROS domain 7 (first free)".
    """

    def __init__(self, domain: int, reason: str, lock: tuple[Path, int] | None = None) -> None:
        super().__init__(lock)
        self.id = domain
        self.reason = f"ROS domain {domain} ({reason})"

    def __enter__(self) -> DomainLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def choose_domain(
    explicit: int | None,
    environ: Mapping[str, str],
    has_external_topics_or_partial: bool,
    *,
    folder: Path | None = None,
) -> DomainLock:
    """The domain for a run: ``explicit``, else ``ROS_DOMAIN_ID``, else 0 or the first free one.

    Args:
        has_external_topics_or_partial: other programs have to find the run, so it gets domain 0.
        folder: of the lock files; normally the temporary folder that all users share.

    Raises:
        UsageError: for an invalid id.
        EnvironmentFault: if all domains are in use.
    """
    if folder is None:  # not TMPDIR, which may differ from user to user
        shared = Path("/tmp")
        folder = shared if os.access(shared, os.W_OK | os.X_OK) else Path(tempfile.gettempdir())
    if (given := given_domain(explicit, environ)) is not None:
        return _told(given, "ROS_DOMAIN_ID" if explicit is None else "-d", folder)
    if has_external_topics_or_partial:
        return _told(0, "default, where other ROS nodes are", folder)
    ports: set[int] = set()  # UDP ports that are bound in this network namespace
    for table in _UDP_TABLES:
        with contextlib.suppress(OSError), open(table) as lines:
            next(lines)
            # "  sl  local_address ..." with local_address "0100007F:1CE8", all hexadecimal
            ports.update(int(line.split()[1].rpartition(":")[2], 16) for line in lines)
    for domain in AUTOMATIC:
        # Another program may have a DDS participant there (DDSI-RTPS 2.5, 9.6.2): discovery is on
        # port 7400 + 250 x domain, then each participant has two more, from + 10 on.
        base = 7400 + 250 * domain
        if any(base <= port < base + 76 for port in ports):
            continue
        if lock := _lock(folder, domain, fcntl.LOCK_EX):
            return DomainLock(domain, "first free", lock)
    raise EnvironmentFault(
        f"all ROS domains from {AUTOMATIC[0]} to {AUTOMATIC[-1]} are in use on this machine: end "
        "other runs, or choose one with -d/--domain-id"
    )


def given_domain(explicit: int | None, environ: Mapping[str, str]) -> int | None:
    """The domain that a user asks for: ``explicit``, else ``ROS_DOMAIN_ID``; else ``None``.

    Raises:
        UsageError: for an invalid id.
    """
    text = environ.get("ROS_DOMAIN_ID", "").strip()
    if explicit is not None:
        return valid_domain(str(explicit), "-d/--domain-id")
    return valid_domain(text, "ROS_DOMAIN_ID") if text else None


def _told(domain: int, reason: str, folder: Path) -> DomainLock:
    lock = _lock(folder, domain, fcntl.LOCK_SH)
    if lock is None:
        reason += "; another run uses it, too"
    return DomainLock(domain, reason, lock)


def valid_domain(text: str, source: str) -> int:
    """The domain id in a text of ``source``; raises ``UsageError`` for any other text."""
    # Only ASCII digits: int() also accepts "1_0", "+1" and other scripts' digits.
    if text.isascii() and text.isdigit() and int(text) <= _HIGHEST:
        return int(text)
    raise UsageError(
        f"{source}: {text!r} is not a ROS domain id: use a whole number from 0 to 101 (up to"
        f" {_HIGHEST} where the machine's ephemeral ports allow it)"
    )


def _lock(folder: Path, domain: int, kind: int) -> tuple[Path, int] | None:
    """The locked file, or ``None`` if it is held or cannot be opened."""
    path = folder / f"neuros-domain-{domain}.lock"
    while True:
        descriptor = _open(path)
        if descriptor is None:
            return None
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            return None
        if is_same_file(descriptor, path):
            return path, descriptor
        os.close(descriptor)  # its former holder has just removed it


def _open(path: Path) -> int | None:
    # Opening a pipe of this name, made by another user, would block without O_NONBLOCK.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        # Linux refuses O_CREAT on another user's file in a shared folder (fs.protected_regular).
        return os.open(path, flags)
    except FileNotFoundError:
        pass
    except OSError:
        return None
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
    except FileExistsError:
        return _open(path)
    except PermissionError:
        return None
    except OSError as error:
        raise EnvironmentFault(
            f"{path}: the lock file of a ROS domain cannot be made ({error.strerror}): make room"
        ) from error
    os.fchmod(descriptor, 0o666)  # whatever the umask: all users take part
    return descriptor
