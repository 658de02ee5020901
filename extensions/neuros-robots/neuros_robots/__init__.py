"""Robot descriptions in other formats than MuJoCo's: SDF and URDF become an ``MjSpec``.

The entry points are :func:`~neuros_robots.sdf.convert_sdf` and
:func:`~neuros_robots.urdf.read_urdf`. Elements without a counterpart in MuJoCo are never dropped in
silence: all elements that no code has read are listed at the end (:mod:`neuros_robots.elements`).
"""

from neuros.ports import Subcommand

CONVERT = Subcommand(
    "neuros_robots.command", "turn a robot or world in SDF or URDF into a MuJoCo model"
)
