"""A plain ROS program that comes late: prints, as JSON, what it hears and is told."""

import json
import time

import rclpy
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

LIMIT_S = 20.0


def call(kind, name, **fields):
    client = node.create_client(kind, name)
    assert client.wait_for_service(LIMIT_S), name
    future = client.call_async(kind.Request(**fields))
    rclpy.spin_until_future_complete(node, future, timeout_sec=LIMIT_S)
    return future.result()


def set_late(value):
    parameter = Parameter("late", value=value).to_parameter_msg()
    return call(SetParameters, "/gate/set_parameters", parameters=[parameter]).results[0].successful


rclpy.init()
node = rclpy.create_node("late")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
states = []
node.create_subscription(String, "/state", lambda message: states.append(message.data), latched)
wanted = ["gain.p", "limits", "described", "late"]
values = call(GetParameters, "/gate/get_parameters", names=wanted).values
end_s = time.monotonic() + LIMIT_S
while True:
    counts = json.loads(call(Trigger, "/gate/tell").message)
    if (states and counts["awaited"] and counts["greeted"]) or time.monotonic() > end_s:
        break
found = {
    "states": states,
    "greeting": call(Trigger, "/greet").message,
    "gain.p": values[0].double_value,
    "limits": list(values[1].integer_array_value),
    "described": values[2].integer_value,
    "late": values[3].integer_value,
    "set": [set_late(7), set_late(70)],
    "counts": json.loads(call(Trigger, "/gate/tell").message),
}
print(json.dumps(found))
