"""Files of a project that go into its images and packs."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from neuros.errors import Problem
from neuros.project.paths import NOT_COPIED
from neuros.project.scanner import display_name

_OF_ENVIRONMENTS = "pyvenv.cfg"  # PEP 405
_MOST_LINKED = 100_000
_INSTEAD = "put a copy in place of the link, or remove it"


def files_to_copy(project: Path, output: Path) -> tuple[set[Path], list[Problem]]:
    """The files and folders of a project that go into its images, and what cannot go there.

    Paths may go through links. The folder ``output``, virtual environments and links to nothing
    are left out. Problems are links out of the project or into a circle, and devices and the like.
    """
    root, own = project.resolve(), output.resolve()
    found: set[Path] = set()
    wrong: dict[Path, tuple[Path, str]] = {}  # by real place: several paths may lead there
    linked = 0
    # Each with the real folders on its way, and whether the way goes through a link.
    folders: list[tuple[Path, tuple[Path, ...], bool]] = [(project, (root,), False)]
    while folders:
        folder, around, is_linked = folders.pop()
        try:
            names = os.listdir(around[-1])
        except OSError as error:
            wrong[around[-1]] = folder, f"cannot be read ({error.strerror}): allow it"
            continue
        for name in sorted({*names} - NOT_COPIED(str(folder), names)):
            path, place = folder / name, around[-1] / name
            is_link = place.is_symlink()
            target = Path(os.path.realpath(place)) if is_link else place
            if own in (target, *target.parents):
                continue
            if root not in (target, *target.parents):
                wrong[place] = path, f"leads out of the project's folder, to {target}: {_INSTEAD}"
                continue
            try:
                mode = target.stat().st_mode
            except OSError:  # the link leads to nothing
                continue
            through_link = is_linked or is_link
            linked += through_link
            if linked > _MOST_LINKED:
                why = f"with it, links stand for more than {_MOST_LINKED:,} files: {_INSTEAD}"
                wrong[place] = path, why
                folders.clear()
                break
            if stat.S_ISDIR(mode):
                if (target / _OF_ENVIRONMENTS).is_file():
                    continue
                if target in around:
                    wrong[place] = path, f"leads back to a folder that it lies in: {_INSTEAD}"
                    continue
                folders.append((path, (*around, target), through_link))
            elif not stat.S_ISREG(mode):
                wrong[place] = path, "is neither a file nor a folder: remove it"
                continue
            found.add(path)
    return found, [Problem(display_name(path), 0, 0, "", text) for path, text in wrong.values()]
