"""What trainer.py does, with the network in TensorFlow: on a GPU where the node is given one."""

from predictive_coding_tensorflow import TensorFlowNetwork
from trainer import Examples, gather

from neuros.hooks import neuros_initialise

# The hook that is imported is one of this node, too.
__all__ = ["gather", "start"]


@neuros_initialise()
def start(node):
    node.set_user_data(Examples(TensorFlowNetwork))
