"""Tells the gripper what to do, and checks that it does. Written for python-statemachine 2.

The state machine of version 2 has `send` and `id`; version 0 has neither.
"""

import os
import platform
from importlib.metadata import version

from statemachine import State, StateMachine

from neuros.hooks import Optional, neuros_function, neuros_initialise

COMMANDS = int(os.environ["COMMANDS"])
SOFTWARE = (
    f"python-statemachine {version('python-statemachine')} on Python {platform.python_version()}"
)


class Plan(StateMachine):
    close = State(initial=True)
    open = State()
    go_on = close.to(open) | open.to(close)


plan = Plan()
given = 0


@neuros_initialise(outputs="command")
def begin(node):
    node.get_logger().info(f"I run {SOFTWARE}")
    return command(node)


@neuros_function(inputs="state", outputs=Optional("command"))
def check(node, state):
    expected = {"close": "closed", "open": "opened"}[plan.current_state.id]
    seen, _, software = state.data.partition(" by ")
    if seen != expected:
        raise RuntimeError(f"the gripper is {seen}, and not {expected}")
    if given == 1:
        node.get_logger().info(f"the gripper runs {software}")
    if given == COMMANDS:
        node.shutdown(f"the gripper obeyed {given} commands")
        return None
    plan.send("go_on")
    return command(node)


def command(node):
    global given
    given += 1
    packet = node.make_packet("command")
    packet.data = f"{plan.current_state.id} by {SOFTWARE}"
    return packet
