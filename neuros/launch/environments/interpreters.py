"""Other Pythons on this machine: those on the path, and those of pyenv and uv."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.installation.machine import NEWEST, OLDEST, clean_environment, dotted

Version = tuple[int, int]
FILE = ".python-version"
_VERSION = re.compile(r"(?:c?python-?)?(\d+)\.(\d+)(?:\.\d+)*")
_ASK = "import sys; print(sys.implementation.name, *sys.version_info[:2])"
_ANSWER_TIMEOUT_S = 10.0


def wanted_version(folder: Path) -> Version | None:
    """What ``.python-version`` in a container's folder says, as pyenv and uv read it; or ``None``.

    Raises:
        EnvironmentFault: if there are no packages of ROS 2 for that Python.
    """
    file = folder / FILE
    try:
        rows = [row.strip() for row in file.read_text("utf-8").splitlines()]
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise EnvironmentFault(f"{file} cannot be read: {error}") from error
    text = next((row for row in rows if row and not row.startswith("#")), "")
    match = _VERSION.fullmatch(text)
    version = (int(match[1]), int(match[2])) if match else (0, 0)
    if not OLDEST <= version <= NEWEST:
        raise EnvironmentFault(
            f"{file} asks for Python {text!r}: name one that ROS 2 has packages for,"
            f" {dotted(OLDEST)} to {dotted(NEWEST)}"
        )
    return version


def find_python(version: Version, environ: Mapping[str, str]) -> Path | None:
    """A CPython of that version on this machine that runs, or ``None``."""
    for path in _candidates(f"python{dotted(version)}", environ):
        if os.access(path, os.X_OK) and _is_version(path, version, environ):
            return path
    return None


def _candidates(name: str, environ: Mapping[str, str]) -> Iterator[Path]:
    for folder in environ.get("PATH", os.defpath).split(os.pathsep):
        if folder:
            yield Path(folder) / name
    # A shim of pyenv is on the path, and refuses what its settings do not name.
    home = Path(environ.get("HOME") or "/")
    pyenv = Path(environ.get("PYENV_ROOT") or home / ".pyenv") / "versions"
    data = Path(environ.get("XDG_DATA_HOME") or home / ".local/share")
    uv = Path(environ.get("UV_PYTHON_INSTALL_DIR") or data / "uv/python")
    for installations in (pyenv, uv):
        yield from sorted(installations.glob(f"*/bin/{name}"), reverse=True)


def _is_version(path: Path, version: Version, environ: Mapping[str, str]) -> bool:
    try:
        answer = subprocess.run(
            [str(path), "-I", "-S", "-c", _ASK],
            env=clean_environment(environ),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_ANSWER_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return answer.stdout.split() == ["cpython", *map(str, version)]
