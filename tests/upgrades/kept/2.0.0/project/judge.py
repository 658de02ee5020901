"""Sees that each double is one."""

from neuros.hooks import All, neuros_function


@neuros_function(inputs=All("both"))
def judge(node, both):
    number, double = both
    assert double.data == 2 * number.data


@neuros_function(inputs="some")
def look(node, some):
    node.get_logger().info(f"saw {some.data}")
