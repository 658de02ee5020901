"""Uses all of rclpy beside its hooks, and counts what runs, and whether ever two at once."""

import json

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from neuros.hooks import neuros_function, neuros_initialise, neuros_tick

COUNTS = dict.fromkeys(
    ("rounds", "timer", "topic", "greeted", "awaited", "told", "set", "at_once"), 0
)
RUNNING = []


class Alone:
    """Counts, and notes if anything else is running."""

    def __init__(self, name):
        self.name = name

    def __enter__(self):
        COUNTS["at_once"] += len(RUNNING)
        COUNTS[self.name] = COUNTS.get(self.name, 0) + 1
        RUNNING.append(self.name)

    def __exit__(self, *_):
        RUNNING.remove(self.name)


@neuros_initialise(outputs="state")
def begin(node):
    ros = node.get_ros_node()
    greeter = ros.create_client(Trigger, "/greet")

    def on_timer():
        with Alone("timer"):
            if COUNTS["greeted"] == 0 and greeter.service_is_ready():
                greeter.call_async(Trigger.Request()).add_done_callback(on_greeting)

    def on_greeting(future):
        with Alone("greeted"):
            assert future.result().message == "hello"

    async def ask():
        # The first answers may be lost: a client finds a service before that has found the client.
        if greeter.service_is_ready() and not COUNTS["awaited"]:
            answer = await greeter.call_async(Trigger.Request())
            with Alone("awaited"):
                assert answer.message == "hello"

    def on_topic(message):
        with Alone("topic"):
            assert message.data == 1

    def on_set(parameters):
        with Alone("set"):
            return SetParametersResult(successful=all(p.value < 10 for p in parameters))

    def tell(request, response):
        with Alone("told"):
            response.success, response.message = True, json.dumps(COUNTS)
            return response

    ros.create_timer(0.001, on_timer)
    ros.create_timer(0.05, ask)
    ros.create_subscription(Int32, "/sure", on_topic, 10)
    ros.create_service(Trigger, "~/tell", tell)
    assert ros.declare_parameter("described", 1, ParameterDescriptor(description="x")).value == 5
    ros.declare_parameter("late", 3)
    ros.add_on_set_parameters_callback(on_set)
    state = node.make_packet("state")
    state.data = f"ready with {ros.get_parameter('gain.p').value}"
    return state


@neuros_function()
def run_freely(node):
    with Alone("rounds"):
        pass


@neuros_tick(seconds=0.05, outputs="loose")
def publish(node):
    return node.make_packet("loose")


def listening(name):
    def listen(node, packet):
        with Alone(name):
            if COUNTS[name] == 1:
                node.get_logger().info(f"{name} heard: {packet.data}")

    listen.__name__ = f"hear_{name}"
    return neuros_function(inputs=name)(listen)


hear_fast, hear_sure, hear_latched, hear_strict = map(
    listening, ("fast", "sure", "latched", "strict")
)
