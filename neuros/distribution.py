"""Version and folders of the NeuROS that is imported, and the commands of its programs.

A checkout has the folders of data at its top, and links to them in the package; an installed
package has the folders themselves.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import Distribution, EntryPoint

__version__ = "2.0.0"

PACKAGE = Path(__file__).resolve().parent
"""The folder of the package ``neuros``."""

ROOT = PACKAGE.parent
"""The source checkout, where NeuROS is installed from one."""

CONTAINERS = (PACKAGE / "containers").resolve()
"""The folders of NeuROS's own containers."""

EXAMPLES = (PACKAGE / "examples").resolve()
"""What ``neuros example`` copies."""

WORKSPACE = (PACKAGE / "workspace").resolve()
"""``@path`` in project files is relative to it."""


# With -m or -c, Python puts the current folder before all others on its path, and would import from
# there what anybody has left. Its option -P is of Python 3.11, -I leaves out PYTHONPATH and the
# user's packages, and PYTHONSAFEPATH would reach the programs that a plugin starts.
_LEAVE_OUT_FOLDER = 'import sys; sys.path[:1] == [""] and sys.path.pop(0)'
_RUN_MODULE = 'import runpy; runpy.run_module(sys.argv.pop(1), None, "__main__", True)'


def python_command(
    *arguments: str, python: object = sys.executable, code: str = _RUN_MODULE
) -> list[str]:
    """The command of a Python that imports nothing from the current folder.

    Each Python that NeuROS starts is started with it, or isolated (``-I``).

    Args:
        arguments: the module to run (``neuros.cli``), then its arguments; with ``code``: those of
            the code.
        python: the program.
        code: what to run in place of a module; it begins with a simple statement.
    """
    return [str(python), "-c", f"{_LEAVE_OUT_FOLDER}; {code}", *arguments]


def extensions() -> Iterator[tuple[Distribution, list[EntryPoint]]]:
    """The installed distributions with entry points in groups of NeuROS, and these entry points."""
    from importlib import metadata

    for each in metadata.distributions():
        entries = [entry for entry in each.entry_points if entry.group.startswith("neuros.")]
        if entries and each.name != "neuros":
            yield each, entries


def versions() -> str:
    """A line for NeuROS and for each extension, with its version; they are all the same."""
    lines = [f"neuros {__version__}"]
    for name, version in sorted({(each.name, each.version) for each, _ in extensions()}):
        remedy = f"  (that of neuros is needed: {install_command()})"
        lines.append(f"{name} {version}{remedy if version != __version__ else ''}")
    return "\n".join(lines)


def libraries() -> dict[str, Path]:
    """What a Python elsewhere needs on its path to import this NeuROS with its extensions.

    These are the package ``neuros`` and, of each extension, its packages and its metadata; by the
    names that they have on the path.
    """
    found = {PACKAGE.name: PACKAGE}
    for each, entries in extensions():
        for name in {entry.module.partition(".")[0] for entry in entries}:
            spec = find_spec(name)
            for place in (spec.submodule_search_locations or ()) if spec else ():
                found[name] = Path(place)
        kept_name = re.sub(r"[-_.]+", "_", each.name).lower()  # as wheels have it
        folder = Path(str(each.locate_file(f"{kept_name}-{each.version}.dist-info")))
        found[folder.name] = folder
    return found


def install_command(extra: str = "") -> str:
    """The command that installs NeuROS again, with an extra: of the checkout, or with pip."""
    if is_checkout():
        return f"./install.py --extras {extra}" if extra else "./install.py"
    return f"pip install 'neuros[{extra}]'" if extra else "pip install --force-reinstall neuros"


def build_command(container: object) -> str:
    """The command that builds the image of a container: of the checkout, or of the package."""
    if is_checkout():
        return f"./install.py --containers {container}"
    return f"neuros containers build {container}"


def is_checkout() -> bool:
    """Whether NeuROS runs from a source checkout."""
    return (ROOT / "install.py").is_file()
