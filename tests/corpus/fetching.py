"""Packages of the registry, pinned by version and checksum in ``packages.txt``.

Each is downloaded once, into the user's cache; ``pip`` compares its checksum.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from functools import cache
from pathlib import Path

HERE = Path(__file__).resolve().parent
_MOST_S = 600
_PLATFORM = ("--python-version=311", "--implementation=cp", "--only-binary=:all:")
"""Some wheels have libraries for one Python; only their data is read, so any Python will do."""
_LEFT_OUT = re.compile(r".*\.(so[.\d]*|pyd|png|jpe?g|tif|tga|bmp|gif|mp4|py|pyc)", re.IGNORECASE)


class Unreached(Exception):
    """A package that cannot be downloaded; the text says why."""


def requirements() -> list[list[str]]:
    """The groups of ``packages.txt``: of each package name, version and checksum, as pip reads."""
    groups: list[list[str]] = []
    is_inside = False
    for line in (HERE / "packages.txt").read_text("utf-8").splitlines():
        if not line.startswith("#"):
            if line and not is_inside:
                groups.append([])
            if line:
                groups[-1].append(line)
            is_inside = bool(line)
    return groups


@cache
def unpacked(name: str) -> Path:
    """The folder with the files of a package, without pictures and programs.

    Raises:
        Unreached: if it is in no cache, and the registry is not reached or has other bytes.
    """
    (line,) = (row for group in requirements() for row in group if row.startswith(f"{name}=="))
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neuros-tests"
    folder = base / line.partition(" ")[0]
    if folder.is_dir():
        return folder
    download = base / "download" / str(os.getpid())
    download.mkdir(parents=True, exist_ok=True)
    listed = download / "requirements.txt"
    listed.write_text(f"{line}\n", "utf-8")
    platforms = [f"--platform=manylinux_2_{libc}_x86_64" for libc in (28, 17)]
    try:
        subprocess.run(
            [
                *(sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--retries=0"),
                *("--dest", str(download), "--require-hashes", "-r", str(listed)),
                *(*_PLATFORM, *platforms),
            ],
            check=True,
            capture_output=True,
            text=True,
            timeout=_MOST_S,
        )
    except (subprocess.SubprocessError, OSError) as error:
        said = getattr(error, "stderr", "") or str(error)
        errors = [row for row in said.splitlines() if "ERROR" in row] or said.splitlines()
        raise Unreached(f"{name} cannot be downloaded: {errors[-1]}") from error
    (wheel,) = download.glob("*.whl")
    made = download / "files"
    with zipfile.ZipFile(wheel) as files:
        files.extractall(made, [each for each in files.namelist() if not _LEFT_OUT.match(each)])
    wheel.unlink()
    try:
        made.rename(folder)
    except OSError:  # another process was faster
        assert folder.is_dir()
    return folder
