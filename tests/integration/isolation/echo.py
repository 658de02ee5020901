"""Answers what an ordinary ROS program asks."""

from neuros.hooks import neuros_function


@neuros_function(inputs="question", outputs="answer")
def answer(node, question):
    reply = node.make_packet("answer")
    reply.data = f"{question.data} heard"
    return reply
