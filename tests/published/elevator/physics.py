import os

from neuros.hooks import neuros_initialise, neuros_function, Optional
from neuros.simulators.mujoco import MuJoCo

STOREY = 3.0


class Elevator:

    def __init__(self, node):
        self.simulator = MuJoCo(node, os.environ["NEUROS_MODEL"])
        self.goal = None

    def go_to(self, level):
        self.goal = level
        self.simulator.actuate("elevator/lift", level * STOREY)

    def has_arrived(self):
        self.simulator.step_synchronous(10)
        height = self.simulator.data.joint("elevator/lift").qpos[0]
        return self.goal is not None and abs(height - self.goal * STOREY) < 0.2


@neuros_initialise()
def initialise(node):
    node.set_user_data(Elevator(node))


@neuros_function(inputs="command", outputs="_command")
def handle_command(node, command):
    node.get_ros_node().get_logger().info(f"going to level {command.data}")
    node.get_user_data().go_to(command.data)
    return command


@neuros_function(outputs=Optional("sensor_data"))
def step(node):
    elevator = node.get_user_data()
    if not elevator.has_arrived():
        return None
    level = node.make_packet("sensor_data")
    level.data, elevator.goal = elevator.goal, None
    return level
