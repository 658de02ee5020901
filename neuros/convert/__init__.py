"""Robot descriptions in other formats than MuJoCo's: SDF and URDF become an ``MjSpec``.

:func:`neuros.convert.sdf.convert_sdf` and :func:`neuros.convert.urdf.read_urdf` are the way in.
What of a description has no counterpart in MuJoCo is never dropped in silence: an element counts as
taken over once somebody has read it, and all that nobody has read is listed at the end
(:mod:`neuros.convert.report`).
"""
