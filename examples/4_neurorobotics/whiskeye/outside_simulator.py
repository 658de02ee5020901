"""WhiskEye in a simulator of its own, as a plain ROS 2 program: it knows nothing of NeuROS.

It serves the standard ``simulation_interfaces``, as Gazebo, Isaac Sim and O3DE do: whoever steps it
gets the state of the robot's body, and the reading of its IMU on the topic ``/imu``.
"""

import os
from pathlib import Path

import mujoco
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Imu
from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures
from simulation_interfaces.srv import (
    GetEntityState,
    GetSimulatorFeatures,
    ResetSimulation,
    SetSimulationState,
    StepSimulation,
)

MODEL = Path(__file__).parent / "whiskeye.xml"
FEATURES = (
    *(SimulatorFeatures.STEP_SIMULATION_SINGLE, SimulatorFeatures.STEP_SIMULATION_MULTIPLE),
    *(SimulatorFeatures.SIMULATION_RESET, SimulatorFeatures.SIMULATION_STATE_PAUSE),
    *(SimulatorFeatures.SIMULATION_STATE_SETTING, SimulatorFeatures.ENTITY_STATE_GETTING),
)


class Simulator(Node):
    """MuJoCo, which goes on by steps only; every 20 ms of its time the IMU is read."""

    def __init__(self):
        super().__init__("simulator")
        self.model = mujoco.MjModel.from_xml_path(str(MODEL))
        self.data = mujoco.MjData(self.model)
        self.imu_steps = round(0.02 / self.model.opt.timestep)
        self.publisher = self.create_publisher(Imu, "imu", 10)
        self.create_service(GetSimulatorFeatures, "get_simulator_features", self.on_features)
        self.create_service(SetSimulationState, "set_simulation_state", self.on_state)
        self.create_service(ResetSimulation, "reset_simulation", self.on_reset)
        self.create_service(StepSimulation, "step_simulation", self.on_step)
        self.create_service(GetEntityState, "get_entity_state", self.on_entity)
        self.begin()

    def begin(self):
        mujoco.mj_resetData(self.model, self.data)
        self.steps = 0
        # The robot turns, and looks ahead.
        self.data.actuator("pose_theta").ctrl = float(os.environ.get("RATE", "1.0"))
        self.data.actuator("neck_gmbl").ctrl = np.pi / 2

    def stamp(self):
        return rclpy.time.Time(nanoseconds=round(self.data.time * 1e9)).to_msg()

    def on_features(self, request, response):
        response.features.features = FEATURES
        return response

    def on_state(self, request, response):
        paused = request.state.state == SimulationState.STATE_PAUSED
        code = SetSimulationState.Response.ALREADY_IN_TARGET_STATE
        response.result.result = code if paused else Result.RESULT_FEATURE_UNSUPPORTED
        return response

    def on_reset(self, request, response):
        self.begin()
        response.result.result = Result.RESULT_OK
        return response

    def on_step(self, request, response):
        for _ in range(request.steps):
            mujoco.mj_step(self.model, self.data)
            self.steps += 1
            if self.steps % self.imu_steps == 0:
                self.publish_imu()
        response.result.result = Result.RESULT_OK
        return response

    def publish_imu(self):
        mujoco.mj_forward(self.model, self.data)
        velocity = np.zeros(6)
        site = self.model.site("imu_body").id
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 1)
        imu = Imu()
        imu.header.stamp, imu.header.frame_id = self.stamp(), "imu_body"
        rate = imu.angular_velocity
        rate.x, rate.y, rate.z = map(float, velocity[:3])
        self.publisher.publish(imu)

    def on_entity(self, request, response):
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, request.entity)
        if number < 0:
            response.result.result = Result.RESULT_NOT_FOUND
            response.result.error_message = f"there is no body '{request.entity}'"
            return response
        mujoco.mj_forward(self.model, self.data)
        state, body = response.state, self.data.body(number)
        state.header.stamp, state.header.frame_id = self.stamp(), "world"
        at, turned = state.pose.position, state.pose.orientation
        at.x, at.y, at.z = map(float, body.xpos)
        turned.w, turned.x, turned.y, turned.z = map(float, body.xquat)
        response.result.result = Result.RESULT_OK
        return response


def main(simulator=Simulator):
    try:
        rclpy.init()
        rclpy.spin(simulator())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
