"""Makes the virtual environment of a container.

On the launcher's own version of Python it is a layer: its site-packages have what the container
asks for and this environment has not, and everything else is found in this environment. On another
version of Python it has everything, ROS 2 included.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.installation.machine import clean_environment, dotted
from neuros.installation.packages import PIP_INSTALL, run_pip
from neuros.installation.progress import Progress
from neuros.launch.environments.choice import PACKAGE, Choice, own_needs, packages_here
from neuros.launch.environments.reasons import why_no_files, why_no_venv, why_pip_failed

_FULL_BYTES = 0.6e9  # ROS 2, and pip's copies while it works
_BOOTSTRAPPER = "ros_wheels_bootstrapper"


def make(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    """Make the environment, unless somebody else has made it meanwhile.

    Args:
        run_environment: is added to the environment of the programs that this starts.

    Raises:
        EnvironmentFault: with a sentence for the user; then nothing of it is left but the log.
    """
    try:
        choice.entry.folder.parent.mkdir(parents=True, exist_ok=True)
        with choice.entry.locked(wait=False) as is_mine:
            if is_mine:
                return _make(choice, progress, run_environment)
        progress.step(f"waiting for another launch that makes {_words(choice)}")
        with choice.entry.locked():
            _make(choice, progress, run_environment)
    except OSError as error:
        raise _fault(choice, why_no_files(error, choice.entry.folder.parent)) from error


def _make(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    """The same, under the lock."""
    entry = choice.entry
    if entry.python():
        return
    entry.remove()  # what an interrupted run has left
    try:
        _make_venv(choice, progress, run_environment)
        _add_links(choice)
        _install(choice, progress, run_environment)
        entry.settle(is_here=False)
    except BaseException:
        entry.remove()
        raise


def _make_venv(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    folder, because = choice.entry.folder, f" ({', '.join(choice.lacks)})" if choice.lacks else ""
    progress.step(f"making {_words(choice)}{because}: {folder}")
    free_bytes = shutil.disk_usage(folder.parent).free
    if not choice.is_layered and free_bytes < _FULL_BYTES:
        raise _fault(
            choice,
            f"{folder.parent} has {free_bytes / 1e9:.1f} GB free and a whole environment needs"
            f" {_FULL_BYTES / 1e9:.1f} GB: make room (df -h), or set XDG_CACHE_HOME",
        )
    # A layer finds pip where it finds the rest.
    options = ["--without-pip"] if choice.is_layered and _is_here("pip") else []
    made = subprocess.run(
        [str(choice.base), "-m", "venv", *options, str(folder)],
        env={**clean_environment(os.environ), **run_environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode:
        output = (made.stdout + made.stderr).strip()
        raise _fault(choice, why_no_venv(output, dotted(choice.version)))


def _add_links(choice: Choice) -> None:
    """Give it this NeuROS, and, if it is a layer, what is here."""
    folder = choice.entry.folder
    site_packages = folder / "lib" / f"python{dotted(choice.version)}" / "site-packages"
    (site_packages / "neuros").symlink_to(PACKAGE, target_is_directory=True)
    if choice.is_layered:
        rows = [str(path) for path in packages_here()]
        if _is_here(_BOOTSTRAPPER):
            _link_libraries(folder, site_packages)
            rows.append(f"import {_BOOTSTRAPPER}")
        # Lines of a .pth file come behind what is in the environment itself.
        layer = "".join(f"{row}\n" for row in rows)
        (site_packages / "neuros_layer.pth").write_text(layer, "utf-8")


def _link_libraries(folder: Path, site_packages: Path) -> None:
    """The wheels of ROS 2 look for their libraries and files below the prefix of their Python."""
    prefix = Path(sys.prefix)
    libraries = [path for path in (prefix / "lib").iterdir() if not path.name.startswith("python")]
    for path in (*libraries, prefix / "share"):
        link = folder / path.relative_to(prefix)
        if path.exists() and not link.exists():
            link.symlink_to(path)
    for path in (path for here in packages_here() for path in here.glob("ros_*.libs")):
        (site_packages / path.name).symlink_to(path)


def _is_here(package: str) -> bool:
    return any((folder / package).is_dir() for folder in packages_here())


def _install(choice: Choice, progress: Progress, run_environment: Mapping[str, str]) -> None:
    entry, needs = choice.entry, own_needs()
    wanted = ["--requirement", str(choice.requirements.file)]
    # With hashes, pip refuses what has none: then what NeuROS needs comes first, by itself.
    calls = [[*wanted, *needs]]
    if choice.requirements.has_hashes:
        calls = [needs, wanted]
    if not needs:
        raise _fault(choice, f"neuros itself is not installed for {sys.executable}: run install.py")
    progress.step(f"installing {choice.requirements.file} (log: {entry.log})")
    for arguments in calls:
        output = run_pip(
            [str(entry.future_python), *PIP_INSTALL, *arguments],
            entry.folder,
            entry.log,
            progress,
            {**clean_environment(os.environ), **run_environment},
        )
        if output is not None:
            cause = why_pip_failed(output, dotted(choice.version), needs)
            raise _fault(choice, f"{cause} (log: {entry.log})")


def _words(choice: Choice) -> str:
    name = choice.container.name
    return f"the environment of container '{name}', Python {dotted(choice.version)}"


def _fault(choice: Choice, cause: str) -> EnvironmentFault:
    return EnvironmentFault(
        f"container '{choice.container.name}': {choice.requirements.file} is not satisfied here,"
        f" and its environment cannot be made: {cause}"
    )
