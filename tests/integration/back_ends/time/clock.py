"""A hundredth of a second of simulated time per tick of 10 ms."""

from neuros.hooks import neuros_initialise, neuros_tick


@neuros_initialise()
def begin(node):
    node.set_user_data(0)


@neuros_tick(seconds=0.01, outputs="clock")
def step(node):
    node.set_user_data(node.get_user_data() + 1)
    clock = node.make_packet("clock")
    clock.clock.sec, hundredths = divmod(node.get_user_data(), 100)
    clock.clock.nanosec = hundredths * 10_000_000
    return clock
