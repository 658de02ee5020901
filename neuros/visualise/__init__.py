"""Figures for plugins: fed by hooks, drawn by a separate process.

::

    from neuros.visualise import VisualiseRotations

    @neuros_initialise()
    def start(node):
        figure = VisualiseRotations("Head direction")
        figure.add_quaternion("truth", "g")
        figure.add_degrees("estimate", "r")
        node.set_user_data(figure)

    @neuros_function(inputs="pose")
    def show(node, pose):
        node.get_user_data().plot("truth", pose.pose.orientation, stamp_s(pose))

A hook never waits for Matplotlib: what the drawing process cannot take is left out and counted.
With a display there is a window; in any case the figure is saved in the node's folder of the run,
every ten seconds and at the end.
"""

from neuros.visualise.figures import (
    VisualiseImages,
    VisualiseLines,
    VisualiseRing,
    VisualiseRotations,
    VisualiseSpikes,
)

__all__ = [
    "VisualiseImages",
    "VisualiseLines",
    "VisualiseRing",
    "VisualiseRotations",
    "VisualiseSpikes",
]
