"""Version and folders of the NeuROS that is imported, and the commands that add to it.

A checkout has the folders of data at its top, and links to them in the package; an installed
package has the folders themselves.
"""

from pathlib import Path

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
