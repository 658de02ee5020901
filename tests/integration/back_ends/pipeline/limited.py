"""Takes a number every 20 ms at most, although it could see others in between."""

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise, neuros_tick


@neuros_initialise()
def begin(node):
    node.set_user_data([])


@neuros_tick(seconds=0.02, outputs="permit")
def permit(node):
    return node.make_packet("permit")


@neuros_function(inputs=["number", "permit"])
def take(node, number, _):
    node.get_user_data().append(number.data)


@neuros_finalise()
def end(node):
    (node.run_dir / "taken").write_text(" ".join(map(str, node.get_user_data())))
