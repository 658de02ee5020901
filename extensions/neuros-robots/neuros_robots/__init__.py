"""Robot descriptions in other formats than MuJoCo's: SDF and URDF become an ``MjSpec``.

:func:`~neuros_robots.sdf.convert_sdf` and :func:`~neuros_robots.urdf.read_urdf` are the way in.
An unsupported element, without a counterpart in MuJoCo, is never dropped in silence: an element
counts as taken over once it has been read, and all others are listed at the end
(:mod:`neuros_robots.elements`).
"""

from neuros.ports import Subcommand

CONVERT = Subcommand(
    "neuros_robots.command", "turn a robot or world in SDF or URDF into a MuJoCo model"
)
