"""A voter: chooses between two things by a taste of its own, which comes with its name.

THINK_SECONDS is how long it takes to make up its mind.
"""

import os
import time
from random import Random

from neuros.hooks import neuros_function


@neuros_function(inputs="question", outputs="vote")
def choose(node, question):
    time.sleep(float(os.environ.get("THINK_SECONDS", "0")))
    taste = Random(f"{question.data} {node.name}")  # the same in every run
    vote = node.make_packet("vote")
    vote.data = taste.choice(question.data.split(" or "))
    node.get_logger().info(vote.data)
    return vote
