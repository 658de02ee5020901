"""Sees votes as they come; one of its two inputs never gets any."""

from neuros.hooks import All, Optional, neuros_finalise, neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data([])


@neuros_function(inputs=["vote", Optional(All("extra"))])
def see(node, vote, extra):
    assert isinstance(extra, list)
    node.get_user_data().append((vote.data, *(each and each.data for each in extra)))


@neuros_finalise()
def end(node):
    (node.run_dir / "seen").write_text(repr(node.get_user_data()))
