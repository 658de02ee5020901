"""Small Python packages made on the spot, for tests that install some without a network."""

from __future__ import annotations

import tarfile
import zipfile
from io import BytesIO
from pathlib import Path

# Builds the wheel that lies beside it, as soon as the file `go` exists; says that it has begun.
_BACKEND = """
import pathlib, shutil, time
FOLDER = pathlib.Path({folder!r})
def build_wheel(target, config_settings=None, metadata_directory=None):
    with open(FOLDER / "builds", "a") as builds:
        builds.write("one\\n")
    while not (FOLDER / "go").exists():
        time.sleep(0.05)
    wheel = next((FOLDER / "built").glob("*.whl"))
    shutil.copy(wheel, target)
    return wheel.name
"""


def make_wheel(folder: Path, name: str, version: str, code: str = "") -> Path:
    """A wheel with one module, in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    info = f"{name}-{version}.dist-info"
    files = {
        f"{name}.py": code,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    records = "".join(f"{file},,\n" for file in (*files, f"{info}/RECORD"))
    path = folder / f"{name}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for file, text in {**files, f"{info}/RECORD": records}.items():
            wheel.writestr(file, text)
    return path


def make_slow_package(folder: Path, name: str, version: str, code: str = "") -> None:
    """A source package in ``folder`` whose build waits until there is a file ``go`` in it.

    Each build that begins adds a line to the file ``builds``.
    """
    make_wheel(folder / "built", name, version, code)
    backend = 'requires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n'
    files = {
        "backend.py": _BACKEND.format(folder=str(folder)),
        "pyproject.toml": f"[build-system]\n{backend}",
        "PKG-INFO": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
    }
    with tarfile.open(folder / f"{name}-{version}.tar.gz", "w:gz") as archive:
        for file, text in files.items():
            member = tarfile.TarInfo(f"{name}-{version}/{file}")
            member.size = len(text.encode())
            archive.addfile(member, BytesIO(text.encode()))
