"""Files that are read and written as a whole, and errors of files in words."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import pwd
import stat
from pathlib import Path
from typing import BinaryIO


def open_ordinary(path: Path) -> BinaryIO:
    """Open a file for reading. Raises ``OSError``: also if it is a pipe, a device or a folder."""

    def opener(name: str, flags: int) -> int:
        descriptor = os.open(name, flags | os.O_NONBLOCK)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            return descriptor
        os.close(descriptor)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), name)
        raise OSError("it is not an ordinary file")

    return open(path, "rb", opener=opener)


def open_new(path: Path) -> BinaryIO:
    """Open a new file in the place of an old one. Raises ``OSError``: also for a folder."""
    path.unlink(missing_ok=True)
    return open(path, "xb")


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file as a whole, or not at all. Raises ``OSError``: also for a folder."""
    part = path.with_name(f".{path.name}")
    try:
        with open_new(part) as file:
            file.write(data)
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def digest_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal. Raises ``OSError``."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while data := file.read(1 << 20):
            digest.update(data)
    return digest.hexdigest()


def reason_of(error: OSError) -> str:
    """The reason of an error, with the file if it is known."""
    reason = error.strerror or str(error)
    return f"{error.filename}: {reason}" if error.filename else reason


def cannot_be_opened(error: OSError) -> str:
    """A sentence about a file or folder; names the folder that the user may not enter."""
    file = os.path.abspath(os.fsdecode(error.filename))
    text = f"{file} cannot be opened ({error.strerror})"
    if error.errno != errno.EACCES:
        return text
    folders = [folder for folder in reversed(Path(file).parents) if os.path.isdir(folder)]
    closed = next((folder for folder in folders if not os.access(folder, os.X_OK)), None)
    place = closed or (file if os.path.lexists(file) else folders[-1])
    what = "you may not enter" if closed else "you have no access to"
    user = os.stat(place, follow_symlinks=False).st_uid
    with contextlib.suppress(KeyError):
        return f"{text}: {what} {place}, which belongs to {pwd.getpwuid(user).pw_name}"
    return f"{text}: {what} {place}, which belongs to user {user}"
