"""Listens to three topics."""

from neuros.hooks import Optional, neuros_function


@neuros_function(inputs=[Optional("heard"), Optional("mistaken"), "unheard"])
def listen(node, heard, mistaken, unheard):
    pass
