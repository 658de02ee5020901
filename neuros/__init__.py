"""NeuROS: closed perception-action loops of simulators, spiking networks and robots, on ROS 2.

Plugins import what they declare with from :mod:`neuros.hooks`; everything else reaches them
through the ``node`` object that every hook receives, a :class:`NodeHandle`. Programs describe
projects with :class:`Node` and :class:`Connection`, run them with :class:`Project`, and look at
what comes out with :class:`Run`.
"""

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuros.api.project import Project
    from neuros.api.run import Run
    from neuros.distribution import __version__
    from neuros.node.handle import NodeHandle
    from neuros.project.in_python import PythonConnection as Connection
    from neuros.project.in_python import PythonNode as Node

__all__ = ["Connection", "Node", "NodeHandle", "Project", "Run", "__version__"]


def __getattr__(name: str) -> Any:
    """Import these only when they are asked for: every node imports this package."""
    if name == "Connection":
        from neuros.project.in_python import PythonConnection

        return PythonConnection
    if name == "Node":
        from neuros.project.in_python import PythonNode

        return PythonNode
    if name == "NodeHandle":
        from neuros.node.handle import NodeHandle

        return NodeHandle
    if name == "Project":
        from neuros.api.project import Project

        return Project
    if name == "Run":
        from neuros.api.run import Run

        return Run
    if name == "__version__":
        from neuros.distribution import __version__

        return __version__
    if not name.startswith("_"):
        from neuros.registry import NAMES

        if name in NAMES or NAMES.missing(name):
            return NAMES.load(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class _Extensions:
    """Finds modules that extensions add to this package; asked when no other finder has one."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
        """The module spec (:class:`importlib.abc.MetaPathFinder`)."""
        if not name.startswith("neuros."):
            return None
        from neuros.registry import spec_of_name

        return spec_of_name(name)


sys.meta_path.append(_Extensions)
