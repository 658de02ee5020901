"""The chair of a meeting: asks, waits until everybody has voted, counts, asks the next question."""

import os
from collections import Counter

from neuros.hooks import All, Optional, neuros_function, neuros_initialise


@neuros_initialise(outputs="question")
def open_the_meeting(node):
    questions = iter(os.environ["QUESTIONS"].split(","))
    node.set_user_data(questions)
    return ask(node, next(questions))


# All: one packet of every connection to this input, as a list. However many voters the project
# file connects, this hook runs when each of them has answered.
@neuros_function(inputs=All("vote"), outputs=Optional("question"))
def count(node, votes):
    result = Counter(vote.data for vote in votes).most_common()
    text = ", ".join(f"{number} for {choice}" for choice, number in result)
    is_tie = len(result) > 1 and result[0][1] == result[1][1]
    node.get_logger().info(f"{text}: {'a tie' if is_tie else result[0][0]}")
    question = next(node.get_user_data(), None)
    if question is None:
        node.shutdown("no more questions")
        return None
    return ask(node, question)


def ask(node, question):
    node.get_logger().info(f"{question.strip()}?")
    packet = node.make_packet("question")
    packet.data = question.strip()
    return packet
