"""Sends a packet ten times a second and takes what comes; ``heard`` is written at the first one."""

from neuros.hooks import neuros_function, neuros_tick


@neuros_tick(seconds=0.1, outputs="said")
def say(node):
    return node.make_packet("said")


@neuros_function(inputs="heard")
def hear(node, packet):
    if node.get_user_data() is None:
        node.set_user_data(True)
        (node.run_dir / "heard").write_text("yes")
