"""Writes a digest of all that has come."""

import hashlib

from rclpy.serialization import serialize_message

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data({name: hashlib.sha256() for name in ("number", "total")})


@neuros_function(inputs="number")
def take_number(node, number):
    node.get_user_data()["number"].update(serialize_message(number))


@neuros_function(inputs="total")
def take_total(node, total):
    node.get_user_data()["total"].update(serialize_message(total))


@neuros_finalise()
def end(node):
    text = "\n".join(digest.hexdigest() for digest in node.get_user_data().values())
    (node.run_dir / "digest").write_text(text)
