from neuros.hooks import neuros_function
from neuros.time import to_stamp

STEP_S = 0.02
steps = 0


@neuros_function(outputs="clock")
def step(node):
    global steps
    steps += 1
    packet = node.make_packet("clock")
    packet.clock = to_stamp(round(steps * STEP_S, 9))
    return packet
