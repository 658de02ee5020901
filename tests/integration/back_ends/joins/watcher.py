"""Sees votes as they come, and those of the other voter that are there by then.

The others may be late, also for the last vote: with room for fewer than all of them their sender
could wait for this node, and this node for the next vote, for ever.
"""

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
