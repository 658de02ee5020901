"""Opens and closes on command. Written for python-statemachine 0, years ago.

The state machine of version 0 has `run` and `identifier`; version 2 has neither.
"""

import platform
from importlib.metadata import version

from statemachine import State, StateMachine

from neuros.hooks import neuros_function, neuros_initialise

SOFTWARE = (
    f"python-statemachine {version('python-statemachine')} on Python {platform.python_version()}"
)


class Gripper(StateMachine):
    opened = State("opened", initial=True)
    closed = State("closed")
    close = opened.to(closed)
    open = closed.to(opened)


gripper = Gripper()
commands = 0


@neuros_initialise()
def begin(node):
    node.get_logger().info(f"I run {SOFTWARE}")


@neuros_function(inputs="command", outputs="state")
def obey(node, command):
    global commands
    commands += 1
    what, _, software = command.data.partition(" by ")
    if commands == 1:
        node.get_logger().info(f"the planner runs {software}")
    gripper.run(what)
    state = node.make_packet("state")
    state.data = f"{gripper.current_state.identifier} by {SOFTWARE}"
    return state
