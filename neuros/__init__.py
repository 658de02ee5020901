"""NeuROS: closed perception-action loops of simulators, spiking networks and robots, on ROS 2.

Plugins import what they declare with from :mod:`neuros.hooks`; everything else reaches them
through the ``node`` object that every hook receives. Programs run projects with :class:`Project`,
and look at what comes out with :class:`Run`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuros.api.project import Project
    from neuros.api.run import Run
    from neuros.api.sweep import sweep
    from neuros.distribution import __version__
    from neuros.node.handle import NodeHandle as Node

__all__ = ["Node", "Project", "Run", "__version__", "sweep"]


def __getattr__(name: str) -> Any:
    """Import these only when they are asked for: every node imports this package."""
    if name == "Node":
        from neuros.node.handle import NodeHandle

        return NodeHandle
    if name == "Project":
        from neuros.api.project import Project

        return Project
    if name == "Run":
        from neuros.api.run import Run

        return Run
    if name == "sweep":
        from neuros.api.sweep import sweep

        return sweep
    if name == "__version__":
        from neuros.distribution import __version__

        return __version__
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
