"""Asks ten questions; takes all votes on each; counts in a connection to itself."""

from neuros.hooks import All, Optional, neuros_finalise, neuros_function, neuros_initialise

ROUNDS = 10


@neuros_initialise(outputs=["question", "round"])
def begin(node):
    node.set_user_data([])
    return number(node, "question", 1), number(node, "round", 1)


@neuros_function(
    inputs=[All("votes"), "round", Optional("nobody")],
    outputs=[Optional("question"), Optional("round")],
)
def count(node, votes, round_, nobody):
    assert nobody is None
    node.get_user_data().append(",".join(vote.data for vote in votes))
    if round_.data == ROUNDS:
        node.shutdown("all questions are answered")
        return None
    return (
        number(node, "question", round_.data + 1),
        number(node, "round", round_.data + 1),
    )


@neuros_finalise()
def end(node):
    (node.run_dir / "rounds").write_text(" ".join(node.get_user_data()))


def number(node, output, value):
    packet = node.make_packet(output)
    packet.data = value
    return packet
