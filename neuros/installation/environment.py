"""The virtual environment ``.venv``: made, filled, tested, and reused by the next installation."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from neuros.errors import EnvironmentFault
from neuros.installation import packages
from neuros.installation.machine import (
    NEWEST,
    NEWEST_FOR_NEST,
    OLDEST,
    clean_environment,
    dotted,
    explain_missing_library,
    system_install,
)
from neuros.installation.progress import Progress

_PROOF_TIMEOUT_S = 180.0


@dataclass(frozen=True)
class _Proof:
    """Code that only runs where a part is really installed, and whose version is shown."""

    name: str
    distribution: str
    code: str


_ROS = _Proof(
    "ROS 2",
    "ros-jazzy-rclpy",
    "import jsonschema, rclpy, sensor_msgs.msg\n"
    "rclpy.utilities.get_rmw_implementation_identifier()",
)
_PROOFS = {
    "mujoco": _Proof(
        "MuJoCo", "mujoco", "import mujoco; mujoco.MjModel.from_xml_string('<mujoco/>')"
    ),
    "nest": _Proof("NEST", "nest-simulator", "import nest; nest.Create('iaf_psc_alpha')"),
    "plot": _Proof("Matplotlib", "matplotlib", "import matplotlib.figure"),
    "tensorflow": _Proof("TensorFlow", "tensorflow-cpu", "import tensorflow"),
    "docs": _Proof("Sphinx", "sphinx", "import sphinx, furo, myst_parser, sphinx_copybutton"),
    "benchmark": _Proof("psutil", "psutil", "import psutil"),
    "dev": _Proof("pytest", "pytest", "import pytest, xdist, hypothesis, mypy, psutil"),
}


def extras_of(pyproject: str) -> tuple[str, ...]:
    """The names of the optional dependencies in the text of ``pyproject.toml``.

    Python 3.10 has no TOML parser; the table is ours and its keys stand at the start of a line.
    """
    table = re.search(
        r"^\[project\.optional-dependencies\]$(.*?)(?=^\[|\Z)", pyproject, re.MULTILINE | re.DOTALL
    )
    return tuple(re.findall(r"^([\w-]+)\s*=", table.group(1), re.MULTILINE)) if table else ()


class Environment:
    """The virtual environment of a source tree, and what it should hold.

    Attributes:
        folder: ``.venv`` in the source tree.
        extras: what is installed beside the core; NEST is left out where there is none.

    ``pip_settings`` are added to the environment of pip.
    """

    def __init__(
        self,
        root: Path,
        extras: Sequence[str],
        progress: Progress,
        pip_settings: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.folder, self.extras = root / ".venv", tuple(extras)
        self._root, self._progress = root, progress
        self._pip_settings = pip_settings
        self._stamp = self.folder / "neuros.json"

    @property
    def python(self) -> Path:
        """The Python in it."""
        return self.folder / "bin" / "python"

    @property
    def is_installed(self) -> bool:
        """Whether an earlier run installed all this from the same ``pyproject.toml``."""
        try:
            stamp = json.loads(self._stamp.read_text("utf-8"))
            extras = set(stamp["extras"])
            return extras >= {*self.extras} and stamp == self._stamp_for(sorted(extras))
        except (OSError, ValueError, LookupError, TypeError):
            return False

    def install(self) -> None:
        """Install what is missing and prove that it works.

        Raises:
            EnvironmentFault: with a sentence for the user.
        """
        if not os.access(self._root, os.W_OK):
            remedy = f"sudo chown -R $(id -un) {self._root}"
            raise EnvironmentFault(f"{self._root} cannot be written: {remedy}")
        version = self.python_version()
        is_new = version is None
        self._leave_out_nest(version or self._make())
        if is_new or not self.is_installed:
            self._fill()
        faults = self._prove()
        if faults and not is_new:
            # Files may be missing that pip believes to be there: an interrupted run, a full disk.
            self._progress.step(f"{faults[0]}; beginning anew")
            self._make()
            self._fill()
            faults = self._prove()
        if faults:
            raise EnvironmentFault(explain_missing_library("; ".join(faults)))
        if not self.is_installed:
            self.write_stamp()
        self.compile()

    def compile(self) -> None:
        """Compile NeuROS's modules, so that no start has to; the folder may be read-only by then.

        What cannot be compiled, or written, Python compiles at each start: no fault.
        """
        command = [str(self.python), "-m", "compileall", "-qq", str(self._root / "neuros")]
        subprocess.run(command, env=clean_environment(os.environ), check=False)

    def write_stamp(self) -> None:
        """Note for the next time what is installed."""
        self._stamp.write_text(json.dumps(self._stamp_for(sorted(self.extras))), "utf-8")

    def _stamp_for(self, extras: list[str]) -> dict[str, object]:
        pyproject = (self._root / "pyproject.toml").read_bytes()
        return {"pyproject": hashlib.sha256(pyproject).hexdigest(), "extras": extras}

    def python_version(self) -> tuple[int, int] | None:
        """The version of its Python, or ``None`` where ``.venv`` is absent or cannot be used."""
        if (self.folder / packages.LOG).exists() and not self._stamp.exists():
            return None  # an installation was interrupted: pip would take half a package for whole
        try:
            # A virtual environment that was moved or copied calls the programs of the old one.
            is_ours = str(self.folder) in (self.folder / "bin" / "pip").read_text("utf-8")[:1000]
            answer = self._run("import sys, pip; print(*sys.version_info[:2])")
            major, minor = map(int, answer.stdout.split())
        except (OSError, ValueError, subprocess.TimeoutExpired):
            return None
        return (major, minor) if is_ours and OLDEST <= (major, minor) <= NEWEST else None

    def _make(self) -> tuple[int, int]:
        """Make it anew, empty, with the Python that runs this."""
        self._progress.step(f"making .venv with Python {platform.python_version()}")
        # Inside a virtual environment (even the one to be replaced) venv needs the base Python.
        base = getattr(sys, "_base_executable", sys.executable)
        command = [base, "-m", "venv", "--clear", str(self.folder)]
        made = subprocess.run(
            command,
            env=clean_environment(os.environ),
            capture_output=True,
            text=True,
            check=False,
        )
        version = sys.version_info[:2]
        if made.returncode:
            shutil.rmtree(self.folder, ignore_errors=True)
            output = (made.stdout + made.stderr).strip()
            if re.search(r"ensurepip|No module named '?venv", output):
                remedy = system_install(apt=f"python{dotted(version)}-venv", dnf="python3-pip")
                raise EnvironmentFault(f"this Python has no venv: {remedy}, then install.py again")
            raise EnvironmentFault(f".venv cannot be made: {output or made.returncode}")
        return version

    def _leave_out_nest(self, version: tuple[int, int]) -> None:
        if version > NEWEST_FOR_NEST and "nest" in self.extras:
            self.extras = tuple(extra for extra in self.extras if extra != "nest")
            self._progress.step(
                f"NEST is left out: it has no packages for Python {dotted(version)} yet "
                "(to have it, remove .venv and run install.py with Python 3.13 or older)"
            )

    def _fill(self) -> None:
        self._stamp.unlink(missing_ok=True)
        packages.install(self.python, self._root, self.extras, self._progress, self._pip_settings)

    def _prove(self) -> list[str]:
        """Use every part in a process of its own; one sentence for each that fails."""
        versions: list[str] = []
        faults: list[str] = []
        with shared_memory_as_found():
            for proof in (_ROS, *(_PROOFS[extra] for extra in self.extras if extra in _PROOFS)):
                self._progress.detail(f"importing {proof.name}")
                try:
                    versions.append(f"{proof.name} {self._version_of(proof)}")
                except (ImportError, subprocess.TimeoutExpired) as error:
                    faults.append(f"{proof.name} does not import ({error})")
        if versions:
            self._progress.step(f"these import: {', '.join(versions)}")
        return faults

    def _version_of(self, proof: _Proof) -> str:
        version = f"import importlib.metadata as m; print(m.version('{proof.distribution}'))"
        answer = self._run(f"import neuros\n{proof.code}\n{version}")
        if answer.returncode:
            rows = answer.stderr.strip().splitlines()
            raise ImportError(rows[-1] if rows else f"exit code {answer.returncode}")
        return answer.stdout.split()[-1]

    def _run(self, code: str) -> subprocess.CompletedProcess[str]:
        """Run ``code`` in its Python, from a folder that holds no modules."""
        return subprocess.run(
            [str(self.python), "-c", code],
            cwd=self.folder,
            # NEST fixes the number of its threads when it is imported.
            env={**clean_environment(os.environ), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=_PROOF_TIMEOUT_S,
            check=False,
        )


@contextlib.contextmanager
def shared_memory_as_found(folder: Path = Path("/dev/shm")) -> Iterator[None]:
    """Remove what importing ROS 2 leaves in shared memory: its tracing library never does."""
    before = set(folder.glob("lttng-ust-wait-*"))
    try:
        yield
    finally:
        for file in set(folder.glob("lttng-ust-wait-*")) - before:
            with contextlib.suppress(OSError):
                file.unlink()
