import os
import time

from neuros.hooks import neuros_function


@neuros_function(inputs="election", outputs="ballot")
def vote(node, election):
    time.sleep(float(os.environ["WALK"]))
    ballot = node.make_packet("ballot")
    ballot.data = os.environ["PARTY"]
    return ballot
