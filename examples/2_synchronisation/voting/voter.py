"""A voter: chooses between two things by a taste of its own, which comes with its name."""

from random import Random

from neuros.hooks import neuros_function


@neuros_function(inputs="question", outputs="vote")
def choose(node, question):
    taste = Random(f"{question.data} {node.name}")  # the same in every run
    vote = node.make_packet("vote")
    vote.data = taste.choice(question.data.split(" or "))
    node.get_logger().info(vote.data)
    return vote
