"""What the ROS wheels from PyPI do to every start of Python, and how hosts are spared it.

The wheels install a ``.pth`` file: each Python of their environment looks for their libraries and
restarts itself once, with ``LD_LIBRARY_PATH`` and a mark in the environment. Two things follow.
A child that runs another environment's Python must not inherit the mark: it would find no
libraries. And a child that runs this Python can be given both, so that it need not start twice.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

_MARK = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
_LIBRARIES = "LD_LIBRARY_PATH"
_BOOTSTRAPPER = "ros_wheels_bootstrapper"


def without_mark(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment for any program: as it was before this Python restarted itself."""
    given = dict(environment)
    if given.pop(_MARK, None) is not None:
        kept = [path for path in _paths(given.pop(_LIBRARIES, "")) if not _is_ours(path)]
        if kept:
            given[_LIBRARIES] = os.pathsep.join(kept)
    return given


def with_libraries(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment for this Python, which need not restart itself in it.

    It is the one that the restart would make. Where the wheels do not restart Python, or not as we
    know it, it stays as it is.
    """
    libraries = _library_paths()
    if not libraries:
        return dict(environment)
    given = [path for path in _paths(environment.get(_LIBRARIES, "")) if path not in libraries]
    return {**environment, _LIBRARIES: os.pathsep.join([*libraries, *given]), _MARK: "1"}


def _library_paths() -> list[str]:
    """The folders that the wheels put in front, or none."""
    # Each start of this Python has imported it. If not, importing it here would restart us.
    find = getattr(sys.modules.get(_BOOTSTRAPPER), "get_ros_paths", None)
    if find is None or _MARK not in os.environ:
        return []
    return sorted(path for path in _paths(str(find())) if _is_ours(path))


def _paths(text: str) -> list[str]:
    return [path for path in text.split(os.pathsep) if path]


def _is_ours(path: str) -> bool:
    prefixes = (str(Path(sys.prefix)), os.path.realpath(sys.prefix))
    return any(path == inside or path.startswith(f"{inside}{os.sep}") for inside in prefixes)
