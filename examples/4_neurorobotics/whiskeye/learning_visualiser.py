"""What correction_visualiser.py draws, and the bias of the gyroscope that the ring has learnt."""

from correction_visualiser import (
    Headings,
    report,
    show_activity,
    show_corrected,
    show_predicted_view,
    show_prediction_error,
    show_truth,
    show_uncorrected,
    show_vision,
)

from neuros.hooks import neuros_function, neuros_initialise
from neuros.time import to_seconds
from neuros.visualise import VisualiseLines

LEARNT = "learnt bias"

# The hooks that are imported are those of this node, too.
__all__ = [
    "report",
    "show_activity",
    "show_bias",
    "show_corrected",
    "show_predicted_view",
    "show_prediction_error",
    "show_truth",
    "show_uncorrected",
    "show_vision",
    "start",
]


@neuros_initialise()
def start(node):
    headings = Headings(node)
    headings.bias = VisualiseLines(LEARNT, None, y_label="rad/s", below=headings.angles)
    headings.bias.add_line(LEARNT)
    node.set_user_data(headings)


@neuros_function(inputs="bias")
def show_bias(node, bias):
    node.get_user_data().bias.plot(LEARNT, bias.vector.z, to_seconds(bias))
