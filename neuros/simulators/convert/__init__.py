"""Robot descriptions in other formats than MuJoCo's: SDF and URDF become an ``MjSpec``.

:func:`~neuros.simulators.convert.sdf.convert_sdf` and
:func:`~neuros.simulators.convert.urdf.read_urdf` are the way in.
An unsupported element, without a counterpart in MuJoCo, is never dropped in silence: an element
counts as taken over once it has been read, and all others are listed at the end
(:mod:`neuros.simulators.convert.elements`).
"""

import os


def _import_mujoco() -> None:
    """Import MuJoCo, also where the OpenGL that ``MUJOCO_GL`` names cannot be imported.

    MuJoCo imports that at once, and only cameras need it: they name what is missing.
    """
    try:
        import mujoco
    except Exception:
        chosen = os.environ.get("MUJOCO_GL")
        if not chosen:
            raise
        os.environ["MUJOCO_GL"] = "disable"
        try:
            import mujoco  # noqa: F401
        finally:
            os.environ["MUJOCO_GL"] = chosen


_import_mujoco()
