import os

from neuros.hooks import neuros_initialise, neuros_function
from neuros.simulators.mujoco import MuJoCo


class Robot:

    STEPS = 20

    def __init__(self, node):
        self.node = node
        self.simulator = MuJoCo(node, os.environ["NEUROS_WORLD"])
        self.simulator.spawn_entity(os.environ["NEUROS_ROBOT"], (0, 0, 0), "robot")
        self.simulator.actuate("robot/pose_theta", float(os.environ["NEUROS_ROTATION_SPEED"]))

    def sense(self):
        self.simulator.step_synchronous(Robot.STEPS)
        data = self.simulator.data
        ground_truth = self.node.make_packet("ground_truth")
        milliseconds = round(self.simulator.sim_time * 1000)
        ground_truth.header.stamp.sec = milliseconds // 1000
        ground_truth.header.stamp.nanosec = milliseconds % 1000 * 1_000_000
        orientation = ground_truth.pose.orientation
        orientation.w, _, _, orientation.z = map(float, data.body("robot/body").xquat)
        imu = self.node.make_packet("imu")
        imu.angular_velocity.z = float(data.sensor("robot/body/imu_body/gyro").data[2])
        return ground_truth, imu


@neuros_initialise()
def initialise(node):
    node.set_user_data(Robot(node))


@neuros_function(outputs=["ground_truth", "imu"])
def step(node):
    return node.get_user_data().sense()
