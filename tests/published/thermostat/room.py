import os

from neuros.hooks import neuros_initialise, neuros_tick, neuros_function


@neuros_initialise()
def set_up(node):
    node.set_user_data({"celsius": float(os.environ["START"]), "heating": 0.0})


@neuros_tick(seconds=0.05, outputs="temperature")
def measure(node):
    room = node.get_user_data()
    room["celsius"] += room["heating"] - 0.5
    packet = node.make_packet("temperature")
    packet.data = room["celsius"]
    return packet


@neuros_function(inputs="heating")
def heat(node, heating):
    node.get_user_data()["heating"] = heating.data
