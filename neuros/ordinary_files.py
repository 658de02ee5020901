"""Files in folders to which nodes in containers may write, as the run folder.

A link there would redirect a write to another file of the user. So these functions write to a new
file, which then gets the name, and follow no links.
"""

from __future__ import annotations

import contextlib
import errno
import os
import pwd
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC


def open_ordinary(path: Path) -> BinaryIO:
    """Open a file for reading. Raises ``OSError``: also if it is a pipe, a device or a folder."""
    return open(path, "rb", opener=lambda *_: descriptor_of(path))


def descriptor_of(path: Path, flags: int = 0) -> int:
    """As :func:`open_ordinary`, a file descriptor; ``flags``: further flags of ``os.open``."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | flags)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return descriptor
    os.close(descriptor)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError("it is not an ordinary file")


def open_new(path: Path) -> BinaryIO:
    """Open a new file in the place of an old one. Raises ``OSError``: also for a folder."""
    path.unlink(missing_ok=True)
    return open(path, "xb")


def open_log(path: Path) -> BinaryIO:
    """Open a file for appending. Raises ``OSError``: also for a link."""
    return open(path, "ab", opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))


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


@contextlib.contextmanager
def folder_in(root: Path, *names: str, makes: bool = False) -> Iterator[Path]:
    """A path to the folder ``names`` below ``root``, which nobody else can replace.

    Within the block the path leads to the same folder, even if another one takes its name.

    Args:
        makes: make folders that are missing.

    Raises:
        OSError: also if one of the names is a link.
    """
    descriptor, folder = os.open(root, _FOLDER), root
    try:
        for name in names:
            folder /= name
            try:
                if makes:
                    with contextlib.suppress(FileExistsError):
                        os.mkdir(name, dir_fd=descriptor)
                below = os.open(name, _FOLDER | os.O_NOFOLLOW, dir_fd=descriptor)
            except OSError as error:
                is_link = error.errno == errno.ENOTDIR
                why = "it is a link, or no folder" if is_link else error.strerror
                raise OSError(error.errno, why, str(folder)) from error
            os.close(descriptor)
            descriptor = below
        held = f"/proc/self/fd/{descriptor}"
        try:
            yield Path(held)
        except OSError as error:
            if not str(error.filename).startswith(held):
                raise
            path = str(folder) + error.filename.removeprefix(held)
            raise OSError(error.errno, error.strerror, path) from error
    finally:
        os.close(descriptor)


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
