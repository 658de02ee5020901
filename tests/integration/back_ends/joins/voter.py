"""Votes once per question."""

import os

from neuros.hooks import neuros_function


@neuros_function(inputs="question", outputs="vote")
def vote(node, question):
    answer = node.make_packet("vote")
    answer.data = f"{os.environ['VOTER']}{question.data}"
    return answer
