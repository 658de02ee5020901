"""A simulation: each step is 10 ms of simulated time, and an image whose grey is its number."""

import math
from array import array

from neuros.hooks import neuros_function, neuros_initialise

WIDTH, HEIGHT = 640, 480


@neuros_initialise()
def start(node):
    node.set_user_data({"step": 0})


@neuros_function(inputs="command")
def obey(node, command):
    node.get_user_data()["command"] = command.data


@neuros_function(outputs=["image", "imu", "clock"])
def simulate(node):
    state = node.get_user_data()
    state["step"] += 1
    step = state["step"]
    image = node.make_packet("image")
    image.width, image.height, image.step, image.encoding = WIDTH, HEIGHT, 3 * WIDTH, "rgb8"
    row = bytes(value for x in range(WIDTH) for value in (step % 256, x * 255 // WIDTH, 60))
    image.data = array("B", row * HEIGHT)
    imu = node.make_packet("imu")
    imu.angular_velocity.z = math.sin(step / 20)
    imu.header.frame_id = "head"
    clock = node.make_packet("clock")
    clock.clock.sec, clock.clock.nanosec = divmod(step * 10_000_000, 1_000_000_000)
    return image, imu, clock
