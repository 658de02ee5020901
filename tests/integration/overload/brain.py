"""Looks for long, and should obey at once."""

from notes import take

from neuros.hooks import neuros_function


@neuros_function(inputs="image")
def look(node, image):
    take(node, "look", image, 0.1)


@neuros_function(inputs="command")
def obey(node, command):
    take(node, "obey", command)
