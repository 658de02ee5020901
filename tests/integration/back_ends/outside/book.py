"""Writes down what has passed."""

from neuros.hooks import neuros_function


@neuros_function(inputs="passed")
def write(node, passed):
    with open(node.run_dir / "book", "a") as file:
        file.write(f"{passed.data}\n")
