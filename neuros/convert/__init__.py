"""Robot descriptions in other formats than MuJoCo's: SDF and URDF become an ``MjSpec``.

:func:`neuros.convert.sdf.convert_sdf` and :func:`neuros.convert.urdf.read_urdf` are the way in.
What of a description has no counterpart in MuJoCo is never dropped in silence: an element counts as
taken over once somebody has read it, and all that nobody has read is listed at the end
(:mod:`neuros.convert.report`).
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
