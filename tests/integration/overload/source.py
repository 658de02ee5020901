"""Sends faster than others can follow."""

from notes import send

from neuros.hooks import neuros_tick


@neuros_tick(seconds=0.01, outputs="image")
def camera(node):
    return send(node, "image")


@neuros_tick(seconds=0.02, outputs="left")
def left(node):
    return send(node, "left")


@neuros_tick(seconds=0.02, outputs="right")
def right(node):
    return send(node, "right")


@neuros_tick(seconds=0.05, outputs="limited")
def limited(node):
    return send(node, "limited")


@neuros_tick(seconds=0.25, outputs="command")
def command(node):
    return send(node, "command")


@neuros_tick(seconds=0.01, outputs="outside")
def outside(node):
    return send(node, "outside")
